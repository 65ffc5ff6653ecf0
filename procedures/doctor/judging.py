"""Evaluates the samples against the requirements of control. Pure functions of `BoardSamples` and the arm."""

import math
from collections.abc import Iterator
from statistics import fmean, median, pstdev

from control.hardware.interface import QUADRATURE_ERROR, SIGNAL_LOST
from control.loop.watch import DRIVE_FAULTS
from control.model.arm import Arm, Drive
from control.model.can_bus import FRAME_bits
from firmware_iface.encoder import wire
from procedures.doctor.boards import BoardSamples, EncoderSamples, MotorSamples
from procedures.doctor.finding import SUPPLY_LIMITS, Finding, Level, graded, percentile

REPLY_S = 0.0005  # within which a board replies
CLOCK_LIMITS_ppm = (500.0, 5000.0)  # speeds are computed by board time: half a percent off is bad
MOVED_counts = 20  # more than the dither of an encoder at rest
NOISE_LIMITS_counts = (1.0, 3.0)
OFFSET_LIMITS = (0.02, 0.1)  # of the current limit; it causes an unwanted torque
TEMPERATURE_LIMITS_degC = (60.0, 80.0)
LOST_LIMITS = (0.0, 0.01)  # of the frames
MOST_NAMED = 3  # number of board messages shown


def judge(samples: BoardSamples, arm: Arm) -> Iterator[Finding]:
    """Return all findings: boards, then buses, then signals."""
    for index, encoder in samples.encoders.items():
        yield from _encoder_timing(f'encoder board "{arm.encoder_boards[index].name}"', encoder, samples, arm, index)
    for joint, motor in samples.motors.items():
        yield from _reply_timing(f"motor board of joint {joint}", motor, samples)
    yield from _buses(samples, arm)
    if arm.placeholders:
        yield Finding(
            Level.WARN,
            "arm",
            "values that nobody has measured",
            " and ".join(arm.placeholders),
            "those of your parts",
            "feed-forward, gains and limits rest on them: write in yours, then take the words out of `placeholders`",
        )
    for drive in arm.drives:
        channel = samples.encoders.get(drive.encoder_board)
        if channel is not None and channel.counts:
            yield from _channel(drive, channel)
        seen = samples.motors.get(drive.joint)
        if seen is not None and seen.current_A:
            if not _has_moved(drive, channel):  # a motor that turns generates a current
                yield _current(drive, seen)
            yield from _power(drive, seen)
    for problem in samples.problems[:MOST_NAMED]:
        yield Finding(Level.BAD, "signals", "a board reported a problem", problem, "", "fix this first")


def _encoder_timing(what: str, stream: EncoderSamples, samples: BoardSamples, arm: Arm, index: int) -> Iterator[Finding]:
    if len(stream.latched_s) < 10:
        text = f"{stream.reports} in {samples.duration_s:.1f} s"
        yield Finding(Level.BAD, "timing", f"{what}: reports", text, "a stream", "check supply, cable and baud rate")
        return
    spans = [b - a for a, b in zip(stream.latched_s, stream.latched_s[1:], strict=False)]
    period_s = min(median(spans), samples.period_s)
    wanted = samples.duration_s / (0.5 * samples.period_s)
    if stream.reports < 0.75 * wanted:  # a slow line carries one report per cycle instead of two
        wanted = samples.duration_s / samples.period_s
    rate_Hz = stream.reports / samples.duration_s
    missing = abs(1.0 - stream.reports / wanted)
    yield graded(
        "timing",
        f"{what}: report rate",
        missing,
        (0.01, 0.05),
        (f"{rate_Hz:.1f} Hz", f"{wanted / samples.duration_s:.0f} Hz", "check for bad frames, and the load of this host"),
    )
    yield from _lost(what, stream)
    yield from _encoder_clock(what, stream, samples, arm.limits.stale_s)
    baud = arm.encoder_boards[index].baud
    load = wire.REPORT_WIRE_BYTES * 10 / baud / period_s
    yield graded(
        "timing",
        f"{what}: load of its serial line",
        load,
        (0.9, 1.0),
        (f"{load:.0%} of {baud} baud", "below 90 %", "choose a higher baud rate, or a lower --rate"),
    )


def _encoder_clock(what: str, stream: EncoderSamples, samples: BoardSamples, stale_s: float) -> Iterator[Finding]:
    drift_ppm, sd_ppm, residual_s = clock_drift(stream.latched_s, stream.arrived_s)
    sd_ppm = math.hypot(sd_ppm, 1e6 * samples.resolution_s / samples.duration_s)
    yield graded(
        "timing",
        f"{what}: clock drift against this host",
        max(0.0, abs(drift_ppm) - 2.0 * sd_ppm),
        CLOCK_LIMITS_ppm,
        (
            f"{drift_ppm:+.0f} ppm, sd {sd_ppm:.0f}",
            f"within {CLOCK_LIMITS_ppm[0]:.0f} ppm",
            ("measured speeds are wrong by as much: check the board's oscillator, and whether this host's clock was adjusted"),
        ),
    )
    late_s = percentile(residual_s, 0.99)
    remedy = "set latency_timer = 1 on an FTDI adapter (/sys/bus/usb-serial/devices/*/latency_timer); avoid a hub"
    yield graded(
        "timing",
        f"{what}: jitter of reports",
        late_s,
        (samples.period_s, stale_s),
        (f"99 % within {1e3 * late_s:.2f} ms", f"below {1e3 * samples.period_s:.2g} ms", remedy),
    )


def _lost(what: str, stream: EncoderSamples) -> Iterator[Finding]:
    total = stream.reports + stream.lost
    yield graded(
        "timing",
        f"{what}: frames lost or broken",
        max(stream.lost, stream.bad_frames) / max(total, 1),
        LOST_LIMITS,
        (
            f"{stream.lost} lost, {stream.bad_frames} with a bad CRC, of {total}",
            "none",
            "check the cable, shield and ground; route the cable away from the motor cables",
        ),
    )


def clock_drift(latched_s: list[float], arrived_s: list[float]) -> tuple[float, float, list[float]]:
    """Drift of a board's clock [ppm], its standard deviation, and the delay of each report over the earliest [s].

    Fits a straight line to arrivals over board time. Delays are never negative, so residuals count from the smallest.
    """
    n = len(latched_s)
    x0, y0 = fmean(latched_s), fmean(arrived_s)
    sxx = math.fsum((x - x0) ** 2 for x in latched_s)
    sxy = math.fsum((x - x0) * (y - y0) for x, y in zip(latched_s, arrived_s, strict=True))
    slope = sxy / sxx if sxx > 0.0 else math.nan
    residual_s = [(y - y0) - slope * (x - x0) for x, y in zip(latched_s, arrived_s, strict=True)]
    variance = math.fsum(r * r for r in residual_s) / max(n - 2, 1)
    earliest_s = min(residual_s)
    sd_ppm = 1e6 * math.sqrt(variance / sxx) if sxx > 0.0 else math.nan
    return 1e6 * (1.0 / slope - 1.0), sd_ppm, [r - earliest_s for r in residual_s]


def _reply_timing(what: str, motor: MotorSamples, samples: BoardSamples) -> Iterator[Finding]:
    if not motor.commands:
        return
    missing = 1.0 - motor.replies / motor.commands
    # The reply to the last command may still be pending.
    yield graded(
        "timing",
        f"{what}: replies",
        max(0.0, missing - 1.0 / motor.commands),
        LOST_LIMITS,
        (f"{motor.replies} to {motor.commands} commands", "one for each", "check CAN cable and termination"),
    )
    p99 = percentile(motor.latency_s, 0.99)
    middle = 1e3 * median(motor.latency_s) if motor.latency_s else math.nan
    yield graded(
        "timing",
        f"{what}: latency of replies",
        p99,
        (samples.period_s, 5.0 * samples.period_s),
        (
            f"{middle:.2f} ms, 99 % within {1e3 * p99:.2f} ms",
            f"within {1e3 * REPLY_S:g} ms and the host's own lateness",
            "check the CAN adapter (USB hubs, slcan at a low baud rate) and the load of this host",
        ),
    )


def _buses(samples: BoardSamples, arm: Arm) -> Iterator[Finding]:
    if arm.can is None or not samples.motors:
        return
    frames = 2 * len(arm.drives)
    computed = frames * FRAME_bits / arm.can.bitrate / samples.period_s
    measured = samples.can_frames * FRAME_bits / arm.can.bitrate / samples.duration_s
    load = max(computed, measured)
    yield graded(
        "timing",
        "CAN bus load",
        load,
        (0.7, 0.9),
        (
            f"{measured:.0%} measured, {computed:.0%} computed at {1.0 / samples.period_s:.0f} Hz",
            "below 70 %",
            "choose a lower --rate or a higher bit rate, and remove other devices from the bus",
        ),
    )


def _channel(drive: Drive, stream: EncoderSamples) -> Iterator[Finding]:
    at = drive.encoder_channel
    what, group = f"joint {drive.joint}: encoder", "signals"
    if at >= len(stream.flags):
        return
    if stream.flags[at] & SIGNAL_LOST:
        yield Finding(Level.BAD, group, what, "its signal is lost", "a signal", "check the encoder's cable and plug")
        return
    if stream.flags[at] & QUADRATURE_ERROR:
        remedy = "check the encoder's cable, shield and supply; then home again"
        yield Finding(Level.WARN, group, what, "illegal transition: the count may be wrong", "", remedy)
    counts = [row[at] for row in stream.counts]
    spread = max(counts) - min(counts)
    if spread > MOVED_counts:
        yield Finding(
            Level.WARN,
            group,
            what,
            f"it moved by {spread} counts",
            "an arm at rest",
            "let the arm rest on its support and run again; noise cannot be measured on a moving joint",
        )
        return
    noise = pstdev(counts)
    homed = "homed" if stream.zero_set[at] else "not homed yet"
    yield graded(
        group,
        what,
        noise,
        NOISE_LIMITS_counts,
        (
            f"noise {noise:.2f} counts at rest, {spread} peak to peak; {homed}",
            f"below {NOISE_LIMITS_counts[0]:g} count",
            "check shield and ground of the encoder's cable",
        ),
    )


def _has_moved(drive: Drive, stream: EncoderSamples | None) -> bool:
    at = drive.encoder_channel
    if stream is None or at >= len(stream.flags):
        return False
    counts = [row[at] for row in stream.counts]
    return max(counts, default=0) - min(counts, default=0) > MOVED_counts


def _current(drive: Drive, motor: MotorSamples) -> Finding:
    joint = f"joint {drive.joint}"
    limit_A = drive.current_limit_A if math.isfinite(drive.current_limit_A) else 10.0
    offset_A, noise_A = fmean(motor.current_A), pstdev(motor.current_A)
    # The larger of the two is graded: either is an unwanted current.
    return graded(
        "signals",
        f"{joint}: current with the drive off",
        max(abs(offset_A), noise_A) / limit_A,
        OFFSET_LIMITS,
        (
            f"{1e3 * offset_A:+.0f} mA, noise {1e3 * noise_A:.0f} mA",
            f"within {OFFSET_LIMITS[0] * limit_A * 1e3:.0f} mA",
            "let the board measure its offset again; check its supply for ripple",
        ),
    )


def _power(drive: Drive, motor: MotorSamples) -> Iterator[Finding]:
    joint = f"joint {drive.joint}"
    supply_V = fmean(motor.supply_V)
    remedy = "check the supply, its fuse and the emergency stop, or correct supply_V in arm.toml"
    yield graded(
        "signals",
        f"{joint}: supply",
        abs(supply_V / drive.supply_V - 1.0),
        SUPPLY_LIMITS,
        (f"{supply_V:.2f} V", f"{drive.supply_V:g} V", remedy),
    )
    hottest = max(motor.temperature_degC)
    yield graded(
        "signals",
        f"{joint}: power stage",
        hottest,
        TEMPERATURE_LIMITS_degC,
        (f"{hottest:.0f} degC", f"below {TEMPERATURE_LIMITS_degC[0]:.0f} degC", "let it cool; check the fan and the load"),
    )
    for bit, (name, cure) in DRIVE_FAULTS.items():
        if motor.faults >> bit & 1:
            yield Finding(
                Level.BAD,
                "signals",
                f"{joint}: drive",
                f"reports a fault: {name}",
                "none",
                f"{cure}; then `armwright acknowledge`",
            )
