"""Commands that run the arm, by way of the runtime's socket."""

from console.options import ARM, JSON, LINKS, RATE, SOCKET, CommandSpec, option

OPERATING = (
    CommandSpec(
        "serve",
        "run the arm: connect its boards and serve the local socket until told to stop",
        (
            ARM,
            *LINKS,
            RATE,
            SOCKET,
            option("--log", metavar="DIR", default="log", help="where recordings go (default: log)"),
        ),
        "Drives stay off until `armwright enable`. Ctrl-C stops the arm, holds it, lowers it on shorted windings and ends.",
    ),
    CommandSpec(
        "check",
        "find the boards that arm.toml names and compare their identities; nothing moves",
        (ARM, *LINKS),
    ),
    CommandSpec("status", "what the arm does now, and what is wrong", (ARM, SOCKET, JSON)),
    CommandSpec("enable", "drives on, holding where the arm stands", (ARM, SOCKET)),
    CommandSpec("home", "find every joint's zero", (ARM, SOCKET)),
    CommandSpec(
        "move",
        "move to joint angles or to a tip position",
        (
            ARM,
            SOCKET,
            option("--joints", type=float, nargs="+", metavar="RAD", help="joint angles in rad"),
            option(
                "--tip",
                type=float,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="tip position in the base frame in m",
            ),
            option(
                "--speed",
                type=float,
                default=0.5,
                metavar="F",
                help="fraction of the joints' limits (default: 0.5)",
            ),
        ),
        "Give one of --joints and --tip.",
    ),
    CommandSpec(
        "run",
        "run a file of way-points through a Cartesian spline",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="CSV with x_m,y_m,z_m and, if wanted, speed_m_s"),
            option("--speed", type=float, metavar="M_S", help="one speed for all way-points, in m/s"),
            option(
                "--plan-only", action="store_true", help="check and say what would be done; needs no runtime"
            ),
        ),
        "Everything is checked before anything moves: reach, joint limits, speed, acceleration, table.",
    ),
    CommandSpec("stop", "controlled stop, then hold", (ARM, SOCKET)),
    CommandSpec("guide", "drives off, to guide the arm by hand: somebody must hold it", (ARM, SOCKET)),
    CommandSpec("hold", "end hand-guiding and hold", (ARM, SOCKET)),
    CommandSpec("acknowledge", "a human has seen the fault", (ARM, SOCKET)),
    CommandSpec(
        "off",
        "stop, hold, lower on shorted windings, drives off",
        (ARM, SOCKET, option("--quit", action="store_true", help="end the runtime too")),
    ),
)
