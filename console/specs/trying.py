"""Commands that need no arm: demos on a mock, and a mock to connect to."""

from console.options import ARM, CELL, CommandSpec, option
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
                help="folder of the results (default: out/demo, out/demo-paper, ...)",
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
    ),
)
