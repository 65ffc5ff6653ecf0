"""The mutable state of an arm under control, read and written by the steps of a cycle.

The steps are functions of it, one module per subject: control.loop.set_points (set-points), motion_modes (motions,
jogs, stops), fault_reactions, homing, shutdown. Each module lists the attributes that it writes; all others only read them.
"""

import math

from control.hardware.board_stop import Bridge
from control.hardware.measurement import Averaging
from control.loop.drives import Bound, DriveStates
from control.loop.homing_sequence import HomingSequence
from control.loop.jogging import Jogging
from control.loop.parts import NOWHERE, Parts, Punctuality
from control.loop.standstill import Standstill
from control.motion.lookout import Lookout
from control.motion.pace import Paced
from control.motion.setpoint import Motion, at_rest
from control.safety.monitor import Monitor
from control.safety.table import CONTROLLED_MODES, Event, Mode

SEARCHING_MODES = frozenset({Mode.HOMING, Mode.JOGGING})


class ArmState:
    """State of the arm: measured values, set-points, mode and motion."""

    def __init__(self, parts: Parts) -> None:
        n = len(parts.joint_names)
        self.parts = parts
        self.monitor = Monitor()
        # the cycle
        self.punctuality = Punctuality(parts.period_s, parts.stopwatch_s, parts.strain)
        self.now_s = 0.0
        # since the last cycle, by the cycle timer; of a pause, what `bridge` leaves
        self.elapsed_s = parts.period_s
        self.has_missed = False  # deadlines, before this cycle
        self.bridge: Bridge | None = None  # what the pause before this cycle meant, if the boards had to stop
        self.cycles = 0
        self.has_waited = False  # for boards, outside of a cycle: deadlines missed meanwhile do not count
        # measured
        self.averaging: Averaging | None = None
        self.camera_m = self.new_camera_m = NOWHERE  # of the last frame; of this cycle's frame
        self.camera_at_s = -math.inf
        self.drives = DriveStates(parts.joint_names)
        self.stillness = Standstill()
        # set-points (set_points)
        self.no_motion = (0.0,) * n  # speeds or accelerations
        self.set_point = self.aim = at_rest(self.no_motion)  # of the joints; of their encoders
        self.is_of_encoders = False  # whether set_point is; only during a motion given in encoder angles
        # motions (motion_modes, homing)
        self.run_number = 0
        self.paced: Paced | None = None  # the active motion or stop
        self.lookout: Lookout | None = None  # of that motion, unless it is a stop
        self.stops_along = False  # whether that motion slows down to rest on its path
        self.override = 1.0  # pace at which motions run
        self.jogging: Jogging | None = None
        self.homing: HomingSequence | None = None
        self.was_stopped = False  # the last motion, before its end
        self.stop_reason = ""  # of the last stop that no client of this arm asked for
        self.is_weightless = False  # gravity compensation during hand guiding
        self.unrecorded = ""  # why cycles are not recorded now; empty while they are
        self.stated_payload_kg = 0.0  # by a client; the model's payload follows it
        self.bound = Bound.NOWHERE  # where the arm is on its way to by itself (shutdown)
        self.fault_rows: tuple[bytes, ...] = ()  # the cycles before the first fault (fault_reactions)
        if parts.hardware.has_torque():
            self.on(Event.FOUND_HELD)

    def on(self, event: Event) -> None:
        """Raise an event; IllegalTransition if the mode does not allow it, and then nothing changes."""
        before = self.monitor.mode
        self.monitor.on(event)
        if self.monitor.mode is not before or event is Event.BRAKE:
            self.stillness.enter_mode(self.now_s)

    def end_way_to_hold(self) -> None:
        """What was asked since, or a fault, ends it; a way off goes on. An arm that was off a moment ago is off again.

        A take-over goes to its end: boards of which some are ours already are safest under control, and then the arm holds.
        """
        if self.monitor.mode is Mode.HELD:
            return
        if self.bound is Bound.ON and self.monitor.mode is Mode.BRAKED:
            self.on(Event.SWITCH_OFF)
        if self.bound.is_hold:
            self.bound = Bound.NOWHERE

    def is_controlled(self) -> bool:
        """Whether the servo works on the set-point."""
        return self.monitor.mode in CONTROLLED_MODES or self.monitor.is_held_fault

    def is_searching(self) -> bool:
        """Whether joints without a known zero are moving."""
        mode = self.monitor.mode
        return mode in SEARCHING_MODES and (mode is Mode.HOMING or not self.monitor.is_homed)

    def is_still(self) -> bool:
        """Whether the arm has come to rest in its present mode."""
        return self.stillness.is_still(self.now_s, self.parts.measurement.speed_rad_s)

    def stands(self) -> bool:
        """Whether the arm is left to its boards, or to shorted windings, is to stay so, and has come to rest."""
        is_left = not self.is_controlled() and self.monitor.mode is not Mode.GUIDING
        return is_left and self.bound is Bound.NOWHERE and self.is_still()

    def is_off(self) -> bool:
        """Whether its drives are off."""
        return self.monitor.mode is Mode.OFF

    def payload_kg(self) -> float:
        """Mass at the tip in the model now; it follows the stated one."""
        return self.parts.loads.at_tip_kg

    def progress(self) -> float:
        """Progress of the active motion, 0 to 1; 1 if there is none."""
        return self.paced.progress if self.paced is not None else 1.0

    def pace(self) -> float:
        """Pace of the active motion, 0 to 1; 1 if there is none."""
        return self.paced.pace if self.paced is not None else 1.0

    @property
    def motion(self) -> Motion | None:
        """The active motion."""
        return self.paced.motion if self.paced is not None else None
