"""Commands that bring a new arm up: is it fit, how is it wired, which gains does it want."""

from console.options import ARM, JSON, LINKS, RATE, CommandSpec, option

MOCK = (
    option("--mock", action="store_true", help="on a mock arm, on a stepped clock"),
    option(
        "--scenario",
        metavar="S",
        help="of the mock: a file or the name of one that ships (default: demo); docs/mock_robot.md",
    ),
    option("--mock-arm", metavar="A", help="what the mock really is (default: what --arm says)"),
)

BRINGUP = (
    CommandSpec(
        "doctor",
        "ports, boards, timing, noise and rights: what is to be mended before the arm moves",
        (
            ARM,
            *LINKS,
            RATE,
            *MOCK,
            option(
                "--seconds",
                type=float,
                default=2.0,
                metavar="S",
                help="how long to listen to the boards (default: 2)",
            ),
            option("--log", metavar="DIR", default="log", help="where recordings will go (default: log)"),
            JSON,
        ),
        "Nothing is energised, nothing moves. Exit status 1 when something must be mended first.",
    ),
)
