"""Builds the firmware of firmware_iface/firmware with the machine's C compiler, once for each version of it, and loads it."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from firmware_iface.installation import ROOT
from hil_mocks.errors import MockError

SOURCES = ROOT / "firmware_iface" / "firmware"
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
PROTOCOL = 1  # that the firmware speaks
_BUILD_LIMIT_S = 120.0
_COMPILERS = ("cc", "gcc", "clang")


class OutputStructure(ctypes.Structure):
    """aw_output_t."""

    _fields_ = (("kind", ctypes.c_int), ("value", ctypes.c_int32))


_POINTER, _SIZE = ctypes.c_void_p, ctypes.c_size_t
# name: (type of its result, types of its arguments)
_SIGNATURES: dict[str, tuple[type | None, ...]] = {
    "aw_size_of_encoder_board": (_SIZE,),
    "aw_size_of_encoder_setup": (_SIZE,),
    "aw_size_of_encoder_inputs": (_SIZE,),
    "aw_size_of_motor_board": (_SIZE,),
    "aw_size_of_motor_setup": (_SIZE,),
    "aw_size_of_motor_inputs": (_SIZE,),
    "aw_size_of_can_frame": (_SIZE,),
    "aw_motor_init": (None, _POINTER, _POINTER, _POINTER),
    "aw_motor_receive": (ctypes.c_bool, _POINTER, _POINTER, _POINTER, _POINTER),
    "aw_motor_tick": (ctypes.c_bool, _POINTER, _POINTER, _POINTER),
    "aw_motor_state": (ctypes.c_int, _POINTER),
    "aw_motor_faults": (ctypes.c_uint8, _POINTER),
    "aw_motor_count": (ctypes.c_int32, _POINTER, ctypes.c_uint32),
    "aw_motor_output": (OutputStructure, _POINTER),
    "aw_motor_current_limit_mA": (ctypes.c_int32, _POINTER),
    "aw_motor_pin_outputs": (ctypes.c_uint8, _POINTER),
    "aw_motor_pin_levels": (ctypes.c_uint8, _POINTER),
    "aw_current_init": (None, _POINTER, _POINTER),
    "aw_current_step": (ctypes.c_int32, _POINTER, OutputStructure, ctypes.c_int32, ctypes.c_int32, ctypes.c_int32),
    "aw_size_of_current": (_SIZE,),
    "aw_encoder_init": (None, _POINTER, _POINTER, _POINTER),
    "aw_encoder_receive": (None, _POINTER, ctypes.c_char_p, _SIZE, _POINTER),
    "aw_encoder_armed": (ctypes.c_uint8, _POINTER),
    "aw_encoder_index": (None, _POINTER, ctypes.c_uint8, ctypes.c_uint32, ctypes.c_uint32),
    "aw_encoder_count": (ctypes.c_int32, _POINTER, ctypes.c_uint8, ctypes.c_uint32),
    "aw_encoder_quadrature_error": (None, _POINTER, ctypes.c_uint8),
    "aw_encoder_next_report": (ctypes.c_bool, _POINTER, _POINTER),
    "aw_encoder_stream": (None, _POINTER, _POINTER),
    "aw_encoder_take": (_SIZE, _POINTER, _POINTER),
}


class FirmwareError(MockError):
    """The firmware cannot be built on this machine."""


def compiler() -> list[str] | None:
    """The command of the C compiler: $CC, else cc, gcc or clang; None if there is none."""
    if chosen := shlex.split(os.environ.get("CC", "")):
        return chosen if shutil.which(chosen[0]) else None
    return next(([name] for name in _COMPILERS if shutil.which(name)), None)


@functools.cache
def library() -> ctypes.CDLL:
    """The firmware, built if need be. FirmwareError says what is missing."""
    command = compiler()
    if command is None:
        raise FirmwareError(
            "the firmware in C needs a C compiler to run on the mock's boards, and this machine has none: apt-get install"
            " gcc, or leave out --firmware c"
        )
    built = _folder() / f"firmware-{_version(command)}.so"
    if not built.exists():
        _build(command, built)
    loaded = ctypes.CDLL(str(built))
    for name, (result, *arguments) in _SIGNATURES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def size_of(what: str) -> int:
    """The size in bytes of a structure of the firmware, `encoder_board` for aw_encoder_board_t."""
    return int(getattr(library(), f"aw_size_of_{what}")())


def require_size(what: str, mirror: type[ctypes.Structure]) -> None:
    """FirmwareError unless Python's mirror of a structure has the size of the original."""
    if (size := size_of(what)) != ctypes.sizeof(mirror):
        raise FirmwareError(
            f"the firmware in C: aw_{what}_t has {size} bytes, its mirror {ctypes.sizeof(mirror)}: change both together"
        )


def build(target: Path, *flags: str, sources: tuple[Path, ...] = ()) -> None:
    """Compile the firmware and `sources` to `target`. FirmwareError with the compiler's words."""
    command = compiler() or ["cc"]
    files = [*sorted((SOURCES / "src").glob("*.c")), *(sources or sorted((SOURCES / "host").glob("*.c")))]
    line = [*command, *FLAGS, *flags, f"-I{SOURCES / 'include'}", *map(str, files), "-o", str(target)]
    try:
        ended = subprocess.run(line, capture_output=True, text=True, timeout=_BUILD_LIMIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as problem:
        raise FirmwareError(f"the firmware in C cannot be built: {problem}") from None
    if ended.returncode != 0:
        words = (ended.stderr.strip() or f"exit status {ended.returncode}").splitlines()
        raise FirmwareError(f"the firmware in C cannot be built: {shlex.join(command)}: {words[0]}")


def _build(command: list[str], built: Path) -> None:
    """Build beside the target and rename: another process may do the same."""
    handle, made = tempfile.mkstemp(suffix=".so", dir=built.parent)
    os.close(handle)
    try:
        build(Path(made), "-shared", "-fPIC")
        Path(made).replace(built)
    finally:
        Path(made).unlink(missing_ok=True)


def _version(command: list[str]) -> str:
    digest = hashlib.sha256(shlex.join([*command, *FLAGS]).encode())
    for file in sorted((*SOURCES.glob("*/*.c"), *SOURCES.glob("*/*.h"))):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@functools.cache
def _folder() -> Path:
    """Where libraries are kept: the user's cache, or a folder of this process where that is not writable or not the user's."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "armwright"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK):
            return folder
    except (OSError, RuntimeError):
        pass
    return Path(tempfile.mkdtemp(prefix="armwright-firmware-"))
