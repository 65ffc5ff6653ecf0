"""Commands that need no arm: the whole job on a mock, and a mock to connect to."""

from console.options import ARM, CommandSpec, option

TRYING = (
    CommandSpec(
        "demo",
        "the whole job on a mock arm: home, move, record the table, calibrate, verify, report",
        (
            option(
                "what",
                nargs="?",
                choices=("job", "paper", "gap"),
                default="job",
                help="the whole job (default), the paper's experiment beside its published figures, or an effect that is"
                " hidden in the arm, found, added to the model and corrected",
            ),
            option(
                "--out",
                metavar="DIR",
                help="where the results go (default: out/demo, out/demo-paper or out/demo-gap)",
            ),
            option(
                "--realtime",
                action="store_true",
                help="the same in real time: own processes, pty and UDP multicast",
            ),
            option(
                "--seed",
                type=int,
                help="seed of what is hidden in the mock arm (default: the scenario's own)",
            ),
            option(
                "--scenario",
                metavar="S",
                help="a scenario file or the name of one that ships (default: demo, or paper)",
            ),
            option("--effect", metavar="NAME", help="demo gap: what is hidden (default: drawn by the seed)"),
            option("--joint", type=int, metavar="J", help="demo gap: where it is hidden (default: drawn)"),
            ARM,
        ),
        "Nothing is connected and nothing real moves.",
    ),
    CommandSpec(
        "mock",
        "a mock arm in real time, for `armwright serve` to connect to",
        (
            ARM,
            option(
                "--scenario",
                default="demo",
                metavar="S",
                help="a scenario file or the name of one that ships",
            ),
        ),
        "Prints the command that connects to it.",
    ),
)
