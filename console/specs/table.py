"""Every subcommand, in the order of `armwright --help`, by job."""

from console.specs.assessing import ASSESSING, PLANNING
from console.specs.calibrating import CALIBRATING, GAP
from console.specs.files import FILES, VISUALISATION
from console.specs.operating import CELLS, END_EFFECTOR, OPERATING
from console.specs.recording import RECORDING
from console.specs.trying import BRINGUP, TRYING

GROUPS = {
    "try it without an arm": TRYING,
    "set up an arm": BRINGUP,
    "operate it": (*OPERATING, *CELLS, *END_EFFECTOR),
    "calibrate it": (*RECORDING, *CALIBRATING),
    "know how far to trust it": (*ASSESSING, *PLANNING),
    "find what the model lacks": GAP,
    "files and recordings": (*FILES, *VISUALISATION),
}
COMMANDS = tuple(command for group in GROUPS.values() for command in group)

FOR_TASKS = {
    "accuracy": ("verify", "trust", "iso9283"),
    "animate": ("view",),
    "backlash": ("gap",),
    "boards": ("check", "doctor"),
    "can": ("doctor", "check"),
    "capture": ("import-capture", "session"),
    "cell": ("serve", "together"),
    "connect": ("check", "serve"),
    "convert": ("export", "export-arm"),
    "create": ("new",),
    "csv": ("export", "import-points"),
    "drift": ("trend", "check-up"),
    "e-stop": ("stop",),
    "emergency": ("stop",),
    "excel": ("import-points", "export"),
    "exit": ("off",),
    "foxglove": ("view", "export"),
    "friction": ("gap", "bringup"),
    "gains": ("tune",),
    "grip": ("gripper",),
    "gui": ("console",),
    "identify": ("calibrate", "gap"),
    "ik": ("move",),
    "import": ("new", "import-points", "import-capture"),
    "init": ("new",),
    "learn": ("export",),
    "lerobot": ("arm", "export", "export-arm"),
    "limits": ("arm", "bringup"),
    "log": ("export", "plot"),
    "measure": ("session", "iso9283"),
    "mjcf": ("new", "export-arm"),
    "path": ("run", "plan-path"),
    "payload": ("arm", "tool"),
    "pid": ("tune",),
    "place": ("mark", "go"),
    "points": ("session", "calibrate"),
    "pose": ("mark", "status"),
    "power": ("enable", "off"),
    "quit": ("off",),
    "record": ("gap", "session"),
    "report": ("calibrate", "verify"),
    "reset": ("acknowledge",),
    "setup": ("new", "bringup"),
    "shutdown": ("off",),
    "sim": ("mock",),
    "simulate": ("mock",),
    "speed": ("override",),
    "spreadsheet": ("import-points", "export"),
    "start": ("serve", "enable"),
    "state": ("status",),
    "test": ("doctor", "drill"),
    "ui": ("console",),
    "urdf": ("new", "export-arm"),
    "video": ("view",),
    "waypoints": ("teach", "run"),
    "webcam": ("camera",),
    "wiring": ("bringup", "doctor"),
    "zero": ("home",),
}
"""Words that are no command but a task, and the commands for it."""
