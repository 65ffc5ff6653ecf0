"""Commands that need no arm, and those that set one up."""

from console.options import ARM, CELL, JSON, LINKS, RATE, CommandSpec, finite, option, scenario
from console.specs.files import MODEL
from control.model.board_kinds import KINDS

FIRMWARE = option(
    "--firmware",
    choices=("python", "c"),
    help="what the mock's reference boards run: the mock's own in Python (default), or the firmware in C of"
    " firmware_iface/firmware, which needs a C compiler",
)

TRYING = (
    CommandSpec(
        "demo",
        "full workflow on a mock arm: home, move, record the table, calibrate, verify, report",
        (
            option(
                "what",
                nargs="?",
                choices=("job", "paper", "gap", "camera", "two-arms"),
                default="job",
                help="job: the full workflow (default); paper: the published experiment with its figures; gap: a"
                " hidden effect, found and corrected; camera: the arm measured by a webcam; two-arms: two arms that touch",
            ),
            option(
                "--out",
                metavar="DIR",
                help="folder of the results; with something in it, the next free one: DIR-2 (default: out/demo, ...)",
            ),
            option(
                "--realtime",
                action="store_true",
                help="run in real time: own processes, pty and UDP multicast",
            ),
            option(
                "--seed",
                type=int,
                metavar="N",
                help="seed of the mock arm's hidden errors (default: the scenario's)",
            ),
            option(
                "--scenario",
                metavar="S",
                help="scenario of the mock arm: a file or a supplied name (default: demo, or paper)",
            ),
            option(
                "--effect", metavar="NAME", help="demo gap: the hidden effect (default: drawn by the seed)"
            ),
            option("--joint", type=int, metavar="J", help="demo gap: its joint (default: drawn)"),
            option(
                "--boards",
                choices=(*KINDS, "mixed"),
                help="drive the arm's joints with bought boards of this kind (docs/boards.md)",
            ),
            ARM,
            option("--cell", metavar="C", help="demo two-arms: a cell.toml with two arms (default: pair)"),
        ),
        "No hardware is connected and nothing real moves.",
    ),
    CommandSpec(
        "drill",
        "a fault on a mock arm: how soon it was noticed, what the arm did, what was lost",
        (
            option(
                "name",
                nargs="?",
                metavar="NAME",
                help="a drill of docs/drills.md, or how several begin (default: all, as a table)",
            ),
            option("--mock", action="store_true", help="required: drills run on a mock arm only"),
            option("--list", action="store_true", help="the names of all drills, and what each does"),
            FIRMWARE,
        ),
        "Exit status 1 if a promise of docs/safety.md was not kept.",
        module="demo",
    ),
    CommandSpec(
        "mock",
        "run a mock arm, or a mock cell, in real time for `armwright serve`",
        (
            ARM,
            CELL,
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="scenario of the mock: a file or a supplied name (default: demo); docs/mock_robot.md",
            ),
            FIRMWARE,
        ),
        "Prints the command that connects to it.",
        module="demo",
    ),
)


MOCK = (
    option("--mock", action="store_true", help="use a mock arm on a stepped clock"),
    scenario(),
    option("--mock-arm", metavar="A", help="the arm that the mock simulates (default: --arm)"),
)
NEW_ARM = option("--out", metavar="NEW.toml", required=True, help="the arm.toml to write; never overwritten")
JOINTS = option("--joint", type=int, metavar="J", action="append", help="only this joint; may be repeated")

BRINGUP = (
    CommandSpec(
        "new",
        "write a commented arm.toml from a few answers, a URDF or MJCF, or like a known arm; it runs on the mock at once",
        (
            NEW_ARM,
            option(
                "--like",
                metavar="ARM",
                help="copy a known arm (docs/arms.md), such as so101; with --name and --ports",
            ),
            option("--name", metavar="NAME", help="the arm's name (default: that of the file)"),
            option("--joints", metavar="N", help="how many joints turn, 2 to 7"),
            option(
                "--axes", metavar="zyy", help="axis of each joint, stretched: z along the arm, y or x across"
            ),
            option(
                "--lengths",
                metavar="M",
                nargs="+",
                help="in m: base to joint 2, joint to joint, last joint to tip",
            ),
            option(
                "--boards",
                metavar="KIND",
                nargs="+",
                help="boards of the joints: one kind for all or one each (docs/boards.md)",
            ),
            option(
                "--gears", metavar="R", nargs="+", help="motor turns per joint turn: one for all or one each"
            ),
            option(
                "--counts",
                metavar="C",
                nargs="+",
                help="counts per turn of the encoder: one for all or one each",
            ),
            option(
                "--encoders",
                metavar="motor|joint",
                help="the side of the gears on which the encoders are (default: motor)",
            ),
            option("--home", metavar="yes|no", help="whether every joint has a home switch and an index"),
            option(
                "--ports",
                metavar="PORT",
                nargs="+",
                help="serial ports of encoder boards (three joints each), RoboClaws, and each kind of servos",
            ),
            option("--can", metavar="I:C", help="CAN bus of the motor boards, such as socketcan:can0"),
            *MODEL,
            option(
                "--yes", action="store_true", help="take the default of every question that no option answers"
            ),
        ),
        "Asks what no option answers; Enter takes the default. A model gives axes, lengths, masses and limits.",
    ),
    CommandSpec(
        "doctor",
        "check ports, boards, timing, noise and rights before the arm moves",
        (
            ARM,
            *LINKS,
            RATE,
            *MOCK,
            option(
                "--seconds",
                type=finite,
                default=2.0,
                metavar="S",
                help="how long to listen to the boards (default: 2)",
            ),
            option(
                "--log",
                metavar="DIR",
                help="folder of the recordings (default: log; with --mock an empty one of its own)",
            ),
            JSON,
        ),
        "Nothing is energised and nothing moves. Exit status 1 if a fault must be fixed first.",
        module="bringup",
    ),
    CommandSpec(
        "bringup",
        "measure wiring, signs, counts, gear, friction and stops joint by joint at low current; write a new arm.toml",
        (
            ARM,
            *LINKS,
            *MOCK,
            NEW_ARM,
            JOINTS,
            option(
                "--current",
                type=finite,
                metavar="A",
                help="largest motor current in A (default: gravity load of the draft, with a margin for friction)",
            ),
            option(
                "--speed",
                type=finite,
                default=0.3,
                metavar="RAD_S",
                help="speed towards the end stops (default: 0.3)",
            ),
            option("--no-stops", action="store_true", help="do not approach the end stops"),
            option(
                "--yes", action="store_true", help="start motions without waiting for Enter; questions remain"
            ),
        ),
        "Stand beside the arm with the emergency stop in hand. After an interruption, the same command continues.",
        module="bringup",
    ),
    CommandSpec(
        "tune",
        "tune PID gains from a measured response, with stability margins and step responses before and after",
        (
            ARM,
            *LINKS,
            *MOCK,
            NEW_ARM,
            JOINTS,
            option(
                "--bandwidth",
                type=finite,
                metavar="HZ",
                help="crossover frequency of the loop (default: as fast as the margins allow)",
            ),
            option(
                "--amplitude",
                type=finite,
                default=0.25,
                metavar="F",
                help="signal amplitude as a fraction of the current limit (default: 0.25)",
            ),
            option(
                "--pose",
                type=finite,
                nargs="+",
                metavar="RAD",
                help="joint angles to tune at (default: arm.toml's [rest])",
            ),
            option("--yes", action="store_true", help="start without asking"),
        ),
        (
            "Writes gains only with margins of at least 6 dB and 45 degrees, delay included. Starts its own runtime: end"
            " others first."
        ),
        module="bringup",
    ),
)
