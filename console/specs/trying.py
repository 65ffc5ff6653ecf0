"""Commands that need no arm, and those that set one up."""

from console.options import ARM, CELL, JSON, LINKS, RATE, CommandSpec, finite, option, scenario
from console.specs.files import MODEL
from control.model.board_kinds import KINDS

FIRMWARE = option(
    "--firmware",
    "what the mock's reference boards run: the mock's own in Python (default), or the firmware in C of"
    " firmware_iface/firmware, which needs a C compiler",
    choices=("python", "c"),
)

TRYING = (
    CommandSpec(
        "demo",
        "full workflow on a mock arm: home, move, record the table, calibrate, verify, report",
        (
            option(
                "what",
                "job: the full workflow (default); paper: the published experiment with its figures; gap: a"
                " hidden effect, found and corrected; camera: the arm measured by a webcam; two-arms: two arms that touch",
                nargs="?",
                choices=("job", "paper", "gap", "camera", "two-arms"),
                default="job",
            ),
            option("--out DIR", "folder of the results; with something in it, the next free one: DIR-2 (default: out/demo, ...)"),
            option("--realtime", "run in real time: own processes, pty and UDP multicast"),
            option("--seed N", "seed of the mock arm's hidden errors (default: the scenario's)", type=int),
            option("--scenario S", "scenario of the mock arm: a file or a supplied name (default: demo, or paper)"),
            option("--effect NAME", "demo gap: the hidden effect (default: drawn by the seed)"),
            option("--joint J", "demo gap: its joint (default: drawn)", type=int),
            option(
                "--boards", "drive the arm's joints with bought boards of this kind (docs/boards.md)", choices=(*KINDS, "mixed")
            ),
            ARM,
            option("--cell C", "demo two-arms: a cell.toml with two arms (default: pair)"),
        ),
        "No hardware is connected and nothing real moves.",
    ),
    CommandSpec(
        "drill",
        "a fault on a mock arm: how soon it was noticed, what the arm did, what was lost",
        (
            option("name NAME", "a drill of docs/drills.md, or how several begin (default: all, as a table)", nargs="?"),
            option("--mock", "required: drills run on a mock arm only"),
            option("--list", "the names of all drills, and what each does"),
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
                "--scenario S",
                "scenario of the mock: a file or a supplied name (default: demo); docs/mock_robot.md",
                default="demo",
            ),
            FIRMWARE,
        ),
        "Prints the command that connects to it.",
        module="demo",
    ),
)


MOCK = (
    option("--mock", "use a mock arm on a stepped clock"),
    scenario(),
    option("--mock-arm A", "the arm that the mock simulates (default: --arm)"),
)
NEW_ARM = option("--out NEW.toml", "the arm.toml to write; never overwritten", required=True)
JOINTS = option("--joint J", "only this joint; may be repeated", type=int, action="append")

BRINGUP = (
    CommandSpec(
        "new",
        "write a commented arm.toml from a few answers, a URDF or MJCF, or like a known arm; it runs on the mock at once",
        (
            NEW_ARM,
            option("--like ARM", "copy a known arm (docs/arms.md), such as so101; with --name and --ports"),
            option("--name NAME", "the arm's name (default: that of the file)"),
            option("--joints N", "how many joints turn, 2 to 7"),
            option("--axes zyy", "axis of each joint, stretched: z along the arm, y or x across"),
            option("--lengths M", "in m: base to joint 2, joint to joint, last joint to tip", nargs="+"),
            option("--boards KIND", "boards of the joints: one kind for all or one each (docs/boards.md)", nargs="+"),
            option("--gears R", "motor turns per joint turn: one for all or one each", nargs="+"),
            option("--counts C", "counts per turn of the encoder: one for all or one each", nargs="+"),
            option("--encoders motor|joint", "the side of the gears on which the encoders are (default: motor)"),
            option("--home yes|no", "whether every joint has a home switch and an index"),
            option(
                "--ports PORT",
                "serial ports of encoder boards (three joints each), RoboClaws, and each kind of servos",
                nargs="+",
            ),
            option("--can I:C", "CAN bus of the motor boards, such as socketcan:can0"),
            *MODEL,
            option("--yes", "take the default of every question that no option answers"),
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
            option("--seconds S", "how long to listen to the boards (default: 2)", type=finite, default=2.0),
            option("--log DIR", "folder of the recordings (default: log; with --mock an empty one of its own)"),
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
                "--current A",
                "largest motor current in A (default: gravity load of the draft, with a margin for friction)",
                type=finite,
            ),
            option("--speed RAD_S", "speed towards the end stops (default: 0.3)", type=finite, default=0.3),
            option("--no-stops", "do not approach the end stops"),
            option("--yes", "start motions without waiting for Enter; questions remain"),
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
            option("--bandwidth HZ", "crossover frequency of the loop (default: as fast as the margins allow)", type=finite),
            option(
                "--amplitude F", "signal amplitude as a fraction of the current limit (default: 0.25)", type=finite, default=0.25
            ),
            option("--pose RAD", "joint angles to tune at (default: arm.toml's [rest])", type=finite, nargs="+"),
            option("--yes", "start without asking"),
        ),
        (
            "Writes gains only with margins of at least 6 dB and 45 degrees, delay included. Starts its own runtime: end"
            " others first."
        ),
        module="bringup",
    ),
)
