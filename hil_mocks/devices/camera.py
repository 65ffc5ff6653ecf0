"""The mock camera: rate, clock, noise, latency; datagrams of docs/camera.md."""

from __future__ import annotations

import random
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

Point = tuple[float, float, float]
_FRAME = struct.Struct("<4sBBHIdddd")
_VISIBLE = 1
TIP_MARKER = 0


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """Rate, noise per axis (standard deviation), latency from image to datagram, share of frames without the tip."""

    rate_Hz: float = 100.0
    noise_m: float = 0.00014
    latency_s: float = 0.0
    dropout: float = 0.0
    clock_ppm: float = 0.0
    seed: int = 0


class CameraMock:
    """Takes an image at the first tick at or after each multiple of its period, stamped with that tick's time."""

    def __init__(self, setup: CameraSetup) -> None:
        self.setup = setup
        self._random = random.Random(f"camera {setup.seed}")
        self._sequence = 0
        self._pictures = 0
        self._rate = 1.0 + setup.clock_ppm * 1e-6
        self._on_its_way: deque[tuple[float, bytes]] = deque()
        self.next_s = 0.0  # nothing to do before this time

    def tick(self, now_s: float, tip_m: Callable[[], Point]) -> list[bytes]:
        """Datagrams sent now; `tip_m` is called only when an image is due."""
        due_s = self._pictures / self.setup.rate_Hz
        if now_s >= due_s - 1e-9:
            self._pictures = int((now_s + 1e-9) * self.setup.rate_Hz) + 1
            self._on_its_way.append((now_s + self.setup.latency_s, self._picture(now_s, tip_m())))
        ready = []
        while self._on_its_way and self._on_its_way[0][0] <= now_s + 1e-9:
            ready.append(self._on_its_way.popleft()[1])
        arrival_s = self._on_its_way[0][0] if self._on_its_way else float("inf")
        self.next_s = min(self._pictures / self.setup.rate_Hz, arrival_s) - 1e-9
        return ready

    def _picture(self, now_s: float, tip_m: Point) -> bytes:
        source, noise_m = self._random, self.setup.noise_m
        seen = [value + source.gauss(0.0, noise_m) for value in tip_m]
        is_visible = source.random() >= self.setup.dropout
        if not is_visible:
            seen = [0.0, 0.0, 0.0]
        flags = _VISIBLE if is_visible else 0
        coded = _FRAME.pack(
            b"AWCM", 1, flags, TIP_MARKER, self._sequence & 0xFFFFFFFF, now_s * self._rate, *seen
        )
        self._sequence += 1
        return coded
