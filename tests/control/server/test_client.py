"""The client of the loop, on a runtime that answers by script: how long it waits, and what it says when it waited in vain."""

from __future__ import annotations

import pytest

from control.server.channel import Message, RuntimeGone
from control.server.client import AVERAGE_LIMIT_S, ArmClient, ArmLate, RequestRefused


class Script:
    """A channel whose runtime answers by request; time passes only while the client waits."""

    def __init__(self, **answers: Message) -> None:
        self.now_s = 0.0
        self._answers = answers

    def request(self, message: Message) -> Message:
        return self._answers.get(message["do"], {"ok": True})

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s

    def close(self) -> None: ...


@pytest.mark.parametrize("duration_s", [0.005, 0.5, 3.0])
def test_an_average_that_never_comes_is_waited_for_as_long_as_a_paused_host_may_take(duration_s: float) -> None:
    script = Script(average_result={"ok": True, "average": None}, status={"ok": True, "mode": "HOLDING"})
    with pytest.raises(ArmLate, match="the boards sent no values meanwhile"):
        ArmClient(script).average(duration_s)
    assert script.now_s == pytest.approx(duration_s + AVERAGE_LIMIT_S, abs=0.03)


def test_an_average_that_the_runtime_gave_up_is_not_waited_for() -> None:
    script = Script(average_result={"ok": False, "error": "joint 2 sent no counts"}, status={"ok": True, "mode": "HOLDING"})
    with pytest.raises(ArmLate, match="joint 2 sent no counts"):
        ArmClient(script).average(0.5)
    assert script.now_s < 0.1


def test_a_refusal_carries_the_runtimes_reason() -> None:
    with pytest.raises(RequestRefused, match="not homed"):
        ArmClient(Script(average={"ok": False, "error": "not homed"})).average(0.5)


def test_the_end_of_a_runtime_is_waited_for_beyond_off() -> None:
    script = Script(mode={"ok": True, "mode": "OFF", "step": "", "progress": 0.0, "pace": 1.0})

    def request(message: Message) -> Message:
        if message["do"] == "mode" and script.now_s > 0.5:  # its drives have confirmed it
            raise RuntimeGone("the runtime has ended")
        return Script.request(script, message)

    script.request = request  # type: ignore[method-assign]
    ArmClient(script).off(quit_runtime=True)
    assert script.now_s == pytest.approx(0.5, abs=0.05)


def test_a_runtime_that_does_not_end_is_said() -> None:
    script = Script(mode={"ok": True, "mode": "OFF", "step": "", "progress": 0.0, "pace": 1.0})
    with pytest.raises(ArmLate, match=r"still OFF after .* expected its end"):
        ArmClient(script).off(quit_runtime=True, timeout_s=1.0)
