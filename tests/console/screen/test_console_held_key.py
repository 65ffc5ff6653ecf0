"""Whether a key is still held, from its presses alone."""

from __future__ import annotations

from console.screen.jogging import HeldKey, RENEWAL_least_s, REPEAT_s
from tests.cell import RIGHT


def test_the_first_press_is_new_and_repeats_renew_at_most_25_times_a_second() -> None:
    key = HeldKey()
    assert key.press("J1+", 10.0).is_new
    assert not key.press("J1+", 10.03).is_new
    presses = [key.press("J1+", 10.03 + 0.01 * i) for i in range(1, 101)]
    assert not any(press.is_new for press in presses)
    assert 20 <= sum(press.is_due for press in presses) <= 25


def test_another_key_or_a_gap_begins_anew() -> None:
    key = HeldKey()
    key.press("J1+", 0.0)
    assert key.press("J1-", 0.01).is_new
    assert not key.press("J1-", 0.01 + REPEAT_s).is_new
    assert key.press("J1-", 0.02 + 2 * REPEAT_s).is_new
    key.forget()
    assert key.press("J1-", 0.03 + 2 * REPEAT_s).is_new


def test_repeats_come_often_enough_for_the_runtimes_dead_man() -> None:
    """Slow terminals repeat 11 times a second; the runtime waits 0.2 s by default."""
    assert 1.0 / 11.0 + RENEWAL_least_s < RIGHT.limits.jog_silence_s
