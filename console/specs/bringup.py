"""Commands that bring a new arm up: is it fit, how is it wired, which gains does it want."""

from console.options import ARM, JSON, LINKS, RATE, CommandSpec, finite, option

MOCK = (
    option("--mock", action="store_true", help="on a mock arm, on a stepped clock"),
    option(
        "--scenario",
        metavar="S",
        help="of the mock: a file or the name of one that ships (default: demo); docs/mock_robot.md",
    ),
    option("--mock-arm", metavar="A", help="what the mock really is (default: what --arm says)"),
)
NEW_ARM = option("--out", metavar="NEW.toml", required=True, help="the arm.toml to write; never overwritten")
JOINTS = option("--joint", type=int, metavar="J", action="append", help="only this joint (again for another)")

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
                type=finite,
                default=2.0,
                metavar="S",
                help="how long to listen to the boards (default: 2)",
            ),
            option("--log", metavar="DIR", default="log", help="where recordings will go (default: log)"),
            JSON,
        ),
        "Nothing is energised, nothing moves. Exit status 1 when something must be mended first.",
        module="bringup.doctor",
    ),
    CommandSpec(
        "bringup",
        "joint by joint at low current: wiring, signs, counts, gear, friction, stops; writes a new arm.toml",
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
                help="most that a motor gets (default: what gravity takes by the draft, and some for friction)",
            ),
            option(
                "--speed",
                type=finite,
                default=0.3,
                metavar="RAD_S",
                help="at which joints creep to their end stops (default: 0.3)",
            ),
            option("--no-stops", action="store_true", help="do not go to the end stops"),
            option(
                "--yes", action="store_true", help="begin motions without waiting for Enter; questions remain"
            ),
        ),
        "Somebody stands beside the arm with the emergency stop. Interrupted, the same command goes on where it was.",
        module="bringup.bringup",
    ),
    CommandSpec(
        "tune",
        "PID gains from a measured response, with stability margins; step responses before and after",
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
                help="crossover of the loop (default: as fast as margins with some reserve allow)",
            ),
            option(
                "--amplitude",
                type=finite,
                default=0.25,
                metavar="F",
                help="of the signal: a fraction of the current limit (default: 0.25)",
            ),
            option(
                "--pose",
                type=finite,
                nargs="+",
                metavar="RAD",
                help="joint angles to tune at (default: arm.toml's [rest])",
            ),
            option("--yes", action="store_true", help="begin without asking"),
        ),
        "At least 6 dB and 45 degrees, delay included, or nothing is written. Starts a runtime of its own: end others first.",
        module="bringup.tune",
    ),
)
