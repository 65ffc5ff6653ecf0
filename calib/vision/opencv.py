"""OpenCV, which only this package uses: an optional part of an installation, imported when a picture is read."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calib.errors import VisionError
from control.files import read_bytes

Picture = npt.NDArray[np.uint8]
ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
PICTURE_MOST_px = 50_000_000  # of 8 bits; a picture beyond it is no camera's
PICTURE_MOST_bytes = 64 << 20


def opencv() -> Any:
    """The module cv2. VisionError with the remedy where it is not installed."""
    os.environ.setdefault(
        "OPENCV_IO_MAX_IMAGE_PIXELS", str(PICTURE_MOST_px)
    )  # before a header that lies takes the memory
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # a damaged picture is said in one sentence
    try:
        module = importlib.import_module("cv2")
    except ImportError as error:
        raise VisionError(
            f"pictures are read by OpenCV, which cannot be imported ({error}): pip install 'armwright[camera]',"
            " or pip install opencv-python-headless"
        ) from error
    module.setNumThreads(1)  # the control loop may run beside it
    return module


def picture_files(folder: Path) -> list[Path]:
    """The pictures of a folder by name. VisionError if there are none."""
    if not folder.is_dir():
        raise VisionError(f"{folder}: expected a folder with pictures ({', '.join(ENDINGS)})")
    found = sorted(file for file in folder.iterdir() if file.suffix.lower() in ENDINGS and file.is_file())
    if not found:
        raise VisionError(f"{folder}: holds no picture: expected files ending in {', '.join(ENDINGS)}")
    return found


def png_of(picture: Picture) -> bytes:
    """A grey picture as a PNG file."""
    return bytes(opencv().imencode(".png", picture)[1])


def read_picture(file: Path) -> Picture:
    """The grey picture (height, width) of a file, as the sensor gave it: a turn stated in EXIF is not applied. VisionError."""
    cv2 = opencv()
    try:
        content = np.frombuffer(read_bytes(file, PICTURE_MOST_bytes), np.uint8)
    except OSError as error:
        raise VisionError(f"{file}: cannot be read: {error.strerror}") from error
    try:
        picture = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        picture = None
    if picture is None or picture.size > PICTURE_MOST_px:
        raise VisionError(f"{file}: not a picture that OpenCV can read: save it as PNG or JPEG")
    return np.asarray(picture, dtype=np.uint8)
