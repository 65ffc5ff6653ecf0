"""The arm under control, and what clients ask of it: the requests of control.server.requests. Its cycle is control.loop.cycle."""

from collections.abc import Sequence

from control.end_effector import GripState as GripperState
from control.errors import ArmError
from control.hardware.interface import OutputMode, Wanted
from control.loop import motion_modes, on_and_off, set_points
from control.loop.cycle import Cycle
from control.loop.jogging import JogRequest
from control.motion.pace import Limited
from control.motion.setpoint import Motion, SetPoint
from control.safety.modes import Event, Fault, Mode
from firmware_iface.errors import BoardReset

NO_GRIP_MODES = (Mode.OFF, Mode.HELD, Mode.BRAKED, Mode.FAULT)
# Where an acknowledgement leads that the loop did not hold the arm.
UNCONTROLLED = {Wanted.AS_FOUND: Mode.HELD, Wanted.DISABLED: Mode.OFF, Wanted.ENABLING: Mode.BRAKED, Wanted.ENABLED: Mode.BRAKED}
TOOL_MODES = (Mode.OFF, Mode.HELD, Mode.BRAKED, Mode.HOLDING)  # in which nothing moves, so that the tip may be another one


class Runtime(Cycle):
    """The arm under control with its requests; ArmError says why one is refused."""

    def acknowledge(self) -> tuple[Fault, ...]:
        """Acknowledge the faults on a person's request. Faulted drives are reset; none is switched on by it.

        A reset ends the hold of boards whose host has gone: while boards hold the arm as they were found, none is reset.
        """
        if self.parts.gripper is not None and self.parts.gripper.state is GripperState.FAILED:
            self.parts.gripper.recover()
            self.has_waited = True
            self.parts.hardware.reset_gripper()
        are_drives_faulted = any(self.parts.hardware.feedback.drive_faults)
        is_left_held = on_and_off.is_left_held(self) and self.parts.hardware.has_torque()
        if is_left_held and not self.monitor.faults:
            raise ArmError(
                f"{on_and_off.HELD}, and is let go when their drives are reset: {on_and_off.TAKES_OVER}, `armwright off` lets"
                " it go"
            )
        if not is_left_held and (are_drives_faulted or (self.monitor.mode is Mode.FAULT and not self.monitor.is_held_fault)):
            self.has_waited = True
            try:
                self.parts.hardware.reset_drive_faults()
            except BoardReset:  # nobody saw it restart: it was silent
                self.monitor.forget_home()
                raise
            self.drives.doubt()
            if not self.monitor.faults:
                return ()  # drives that were in FAULT before this runtime started
        cleared = self.monitor.acknowledge(UNCONTROLLED[self.drives.wanted])
        self.stillness.enter_mode(self.now_s)
        return cleared

    def want_hold(self) -> None:
        """Get to HOLDING from OFF, HELD, BRAKED or GUIDING, through the modes in between. ArmError says why not."""
        on_and_off.want_hold(self)

    def go_off(self, quits: bool, lets_go: bool = False) -> None:
        """Start the shutdown: stop, hold, brake, off. `lets_go`: an arm that is held by its boards, too."""
        on_and_off.begin_off(self, quits, lets_go)

    def require_recording(self) -> None:
        """ArmError if nothing is recorded now, and arm.toml says that no motion begins then."""
        if self.unrecorded and not self.parts.allows_unrecorded:
            raise ArmError(
                f"nothing is recorded ({self.unrecorded}), so no motion begins: make room on the disk, or set"
                ' [recording] unrecorded = "allow" in arm.toml; jogs and hand guiding are free'
            )

    def require_staying(self) -> None:
        """ArmError while the arm goes on or off by itself: nothing else begins then."""
        on_and_off.require_staying(self)

    def state_payload(self, mass_kg: float) -> None:
        """State the mass in the gripper. ArmError if it is more than the arm may carry."""
        most_kg = self.parts.payload_limit_kg
        if not 0.0 <= mass_kg <= most_kg:
            raise ArmError(f"payload: expected mass_kg from 0 to {most_kg:g} kg ([limits] payload_limit_kg), got {mass_kg:g}")
        self.stated_payload_kg = mass_kg
        self.parts.loads.state(self.parts.tool.tool, mass_kg)

    def change_tool(self, name: str) -> None:
        """Another tool is on: the tip, the masses and what the arm must not meet are its. ArmError if the arm is not at rest."""
        if name not in self.parts.tools:
            known = ", ".join(tool for tool in self.parts.tools if tool)
            raise ArmError(
                f"tool: no tool {name!r}: expected one of {known}"
                if known
                else f"tool: no tool {name!r}: arm.toml names none; add a [[tool]] for each, with a name"
            )
        if self.monitor.mode not in TOOL_MODES:
            raise ArmError(f"the arm is {self.monitor.mode.name}, so its tool cannot be changed: it must hold at rest, or be off")
        self.parts = self.parts.with_tool(name)
        self.parts.loads.state(self.parts.tool.tool, self.stated_payload_kg)

    def take_known_zeros(self) -> bool:
        """Use the boards' zeros if all of them were set since power-up; return whether they were."""
        return on_and_off.take_known_zeros(self)

    def start_homing(self) -> None:
        """Home every joint, one after the other. ArmError if arm.toml does not describe how."""
        self.require_staying()
        self.require_recording()
        on_and_off.start_homing(self)

    def start(self, motion: Motion, as_encoders: bool = False, beside: Sequence[Limited] = ()) -> None:
        """Start a checked motion that begins, at rest, at the arm's position `seen`; `beside`: others that keep its pace."""
        self.require_staying()
        self.require_recording()
        motion_modes.start(self, motion, as_encoders, beside)

    def jog(self, request: JogRequest) -> None:
        """Start, change or renew a jog; ArmError says why it is refused, and then nothing changes."""
        self.require_staying()
        motion_modes.jog(self, request)

    def renew_jog(self) -> None:
        """Renew the active jog; ArmError if there is none."""
        motion_modes.renew_jog(self)

    def pause(self) -> None:
        """Slow to rest along the motion's path and hold there."""
        self.on(Event.PAUSE)

    def resume(self) -> None:
        """Resume the motion."""
        self.require_recording()
        self.on(Event.RESUME)

    def brake(self) -> None:
        """Short the windings now, without a controlled stop (see `stop`); the gripper stops and holds."""
        if self.parts.gripper is not None:
            self.parts.gripper.stop()
        motion_modes.brake(self)

    def grip(self, action: str, opening_m: float | None, force_N: float | None) -> None:
        """Open, close or move the gripper. ArmError says why not, and then nothing changes."""
        gripper = self.parts.gripper
        if gripper is None:
            raise ArmError("gripper: arm.toml describes none: add a [gripper]")
        if action == "stop":
            gripper.stop()
            return
        self.require_staying()
        if self.monitor.mode in NO_GRIP_MODES:
            raise ArmError(
                f"the arm is {self.monitor.mode.name}, so the gripper does not move: the arm must hold, move or be guided"
            )
        gripper.ask(action, opening_m, force_N)

    def set_output(self, name: str, level: bool) -> None:
        """Set a digital output. ArmError says why not."""
        if self.parts.outputs is None:
            raise ArmError("digital: arm.toml names no pins: add a [[digital]]")
        self.parts.outputs.set(name, level)

    def guide(self, weightless: bool) -> None:
        """Start hand guiding: circuits open, so somebody must hold the arm; or `weightless`, with gravity compensation.

        A board that cannot open its circuit shorts the windings: its joint resists the hand. `weightless` needs a homed arm,
        and boards that take a current: ArmError if not.
        """
        self.monitor.require(Event.GUIDE)
        self.require_staying()
        if not self.drives.is_ready:
            raise ArmError("not all drives are in operation: `armwright enable` first, then guide")
        if weightless and OutputMode.CURRENT not in self.parts.hardware.offers:
            raise ArmError(
                "weightless hand guiding is not possible: not all of this arm's boards take a current as command"
                " (docs/boards.md): guide without it"
            )
        if weightless and not self.monitor.is_homed:
            raise ArmError("gravity compensation needs a homed arm: home it first (`armwright home`)")
        self.is_weightless = weightless
        self.on(Event.GUIDE)
        self.run_number += 1

    def joint_rad(self) -> tuple[set_points.Angles, set_points.Angles]:
        """Actual and set joint angles, corrected for the modelled effects between joints and encoders."""
        measured, wanted = set_points.joint_rad(self)
        return tuple(measured), wanted

    def seen(self, as_encoders: bool) -> SetPoint:
        """The present set-point, as joint angles or as encoder angles."""
        return set_points.seen(self, as_encoders)
