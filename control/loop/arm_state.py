"""All that changes while an arm is under control, in one place: what the steps of a cycle read and write.

The steps are functions of it, one module a subject: control.loop.set_points (where the arm is to be), motion_modes (motions,
jogs, stops), fault_reactions, homing, shutdown. Each module lists the attributes that it changes; all others only read them.
"""

import math

from control.hardware.averaging import Averaging
from control.loop.homing_sequence import HomingSequence
from control.loop.jogging import Jogging
from control.loop.parts import NOWHERE, Parts
from control.loop.punctuality import Punctuality
from control.loop.readiness import DriveReadiness
from control.loop.standstill import Standstill
from control.motion.pace import Paced
from control.motion.setpoint import Motion, at_rest
from control.safety.monitor import Monitor
from control.safety.table import CONTROLLED_MODES, Event, Mode


class ArmState:
    """The arm as the loop knows it and wants it."""

    def __init__(self, parts: Parts) -> None:
        n = len(parts.joint_names)
        self.parts = parts
        self.monitor = Monitor()
        # the cycle
        self.punctuality = Punctuality(parts.period_s, parts.stopwatch_s)
        self.now_s = 0.0
        self.elapsed_s = parts.period_s  # since the last cycle, by the beat
        self.cycles = 0
        self.has_waited = False  # for boards, outside of a cycle: the deadlines meanwhile do not count
        # what is seen
        self.averaging: Averaging | None = None
        self.camera_m = self.new_camera_m = NOWHERE  # of the last frame; of this cycle's
        self.camera_at_s = -math.inf
        self.drives = DriveReadiness(parts.joint_names)
        self.stillness = Standstill()
        # set-points (set_points)
        self.no_motion = (0.0,) * n  # speeds or accelerations
        self.set_point = self.aim = at_rest(self.no_motion)  # of the joints; of their encoders
        self.is_of_encoders = False  # whether set_point is, while a motion runs that was given so
        # motions (motion_modes, homing)
        self.run_number = 0
        self.paced: Paced | None = None  # the motion that runs, a stop too
        self.override = 1.0  # pace at which motions run
        self.jogging: Jogging | None = None
        self.homing: HomingSequence | None = None
        self.was_stopped = False  # the last motion, before its end
        self.is_weightless = False  # while a hand guides the arm: its drives carry it
        # the mode that is wanted (shutdown)
        self.is_hold_pending = False
        self.is_shutting_down = False
        self.is_quitting = False
        self.fault_rows: tuple[bytes, ...] = ()  # the cycles before the first fault (fault_reactions)

    def on(self, event: Event) -> None:
        """Take an event; IllegalTransition when the mode does not allow it, and nothing has changed."""
        before = self.monitor.mode
        self.monitor.on(event)
        if self.monitor.mode is not before or event is Event.BRAKE:
            self.stillness.enter_mode(self.now_s)

    def is_controlled(self) -> bool:
        """Whether the servo works on the set-point."""
        return self.monitor.mode in CONTROLLED_MODES or self.monitor.is_held_fault

    def is_searching(self) -> bool:
        """Whether joints move whose angles mean nothing yet."""
        mode = self.monitor.mode
        return mode is Mode.HOMING or (mode is Mode.JOGGING and not self.monitor.is_homed)

    def is_still(self) -> bool:
        """Whether the arm has come to rest in its present mode."""
        return self.stillness.is_still(self.now_s, self.parts.measurement.speed_rad_s)

    def payload_kg(self) -> float:
        """Mass at the tip, as stated."""
        return self.parts.servo.torque_model.payload_kg

    def progress(self) -> float:
        """How much of the present motion is done, 0 to 1; 1 when there is none."""
        return self.paced.progress if self.paced is not None else 1.0

    def pace(self) -> float:
        """How fast the present motion's time runs, 0 to 1; 1 when there is none."""
        return self.paced.pace if self.paced is not None else 1.0

    @property
    def motion(self) -> Motion | None:
        """The motion that runs."""
        return self.paced.motion if self.paced is not None else None
