"""Commands that run the arm, by way of the runtime's socket."""

from console.options import ARM, JSON, LINKS, RATE, SOCKET, CommandSpec, finite, option

PLACES = option("--places", metavar="FILE", default="places.toml", help="named places (default: places.toml)")
MOVE_SPEED = option(
    "--speed", type=finite, default=0.5, metavar="F", help="fraction of the joints' limits (default: 0.5)"
)
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
        (ARM, *LINKS, JSON),
        module="bringup.check",
    ),
    CommandSpec(
        "console",
        "a full-screen view of the arm, with keys to jog, move, teach and calibrate it",
        (
            ARM,
            SOCKET,
            PLACES,
            option(
                "--teach",
                metavar="FILE",
                default="taught.csv",
                help="way-points taught by hand (default: taught.csv)",
            ),
            option("--keep", metavar="FILE", help="keep every line that was done, for `armwright script`"),
            option(
                "--sessions",
                metavar="DIR",
                default="sessions",
                help="calibration sessions (default: sessions)",
            ),
        ),
        "Space stops the arm, always. `?` shows the keys. It is a client: `armwright serve` runs the arm.",
    ),
    CommandSpec("status", "what the arm does now, and what is wrong", (ARM, SOCKET, JSON)),
    CommandSpec("enable", "drives on, holding where the arm stands", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "home",
        "find every joint's zero",
        (
            ARM,
            SOCKET,
            option("--again", action="store_true", help="search also where the boards know their zeros"),
        ),
        "Nothing moves where all encoder boards still know their zeros.",
        module="requests",
    ),
    CommandSpec(
        "move",
        "move to joint angles or to a tip position",
        (
            ARM,
            SOCKET,
            option("--joints", type=finite, nargs="+", metavar="RAD", help="joint angles in rad"),
            option(
                "--tip",
                type=finite,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="tip position in the base frame in m",
            ),
            MOVE_SPEED,
        ),
        "Give one of --joints and --tip.",
        module="moving",
    ),
    CommandSpec(
        "run",
        "run a file of way-points through a Cartesian spline",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="CSV with x_m,y_m,z_m and, if wanted, speed_m_s"),
            option("--speed", type=finite, metavar="M_S", help="one speed for all way-points, in m/s"),
            option(
                "--plan-only", action="store_true", help="check and say what would be done; needs no runtime"
            ),
        ),
        "Everything is checked before anything moves: reach, joint limits, speed, acceleration, table.",
        module="moving",
    ),
    CommandSpec(
        "go",
        "move to a named place",
        (ARM, SOCKET, PLACES, option("name", metavar="NAME", help="as in the places file"), MOVE_SPEED),
        "The file is TOML: [NAME] with q_rad (one a joint) or tip_m (3).",
        module="moving",
    ),
    CommandSpec(
        "mark",
        "keep where the arm stands as a named place",
        (ARM, SOCKET, PLACES, option("name", metavar="NAME", help="letters, digits, - and _")),
        module="moving",
    ),
    CommandSpec(
        "teach",
        "add where the tip is to a way-point file",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="CSV that `armwright run` takes; begun if it is not there"),
        ),
        "Guide the arm by hand (`armwright guide`), teach, go on; `hold` when done. `run` moves to the first point gently.",
        module="moving",
    ),
    CommandSpec(
        "jog",
        "one step of a joint, or of the tip along an axis of the base frame",
        (
            ARM,
            SOCKET,
            option("--joint", type=int, metavar="J", help="a joint, from 1"),
            option("--axis", choices=("x", "y", "z"), help="an axis of the base frame"),
            option(
                "--by", type=finite, required=True, metavar="STEP", help="rad of a joint, m along an axis"
            ),
            option("--speed", type=finite, metavar="V", help="rad/s or m/s (default: the limit for jogging)"),
        ),
        "The arm stops at once when the command is interrupted. Exit status 1 when something was in the way.",
        module="moving",
    ),
    CommandSpec(
        "pause", "slow to rest along the motion that runs, and hold on it", (ARM, SOCKET), module="requests"
    ),
    CommandSpec("resume", "go on along the motion", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "override",
        "pace of motions, of the one that runs and of those to come",
        (ARM, SOCKET, option("fraction", type=finite, metavar="F", help="0.01 to 1 of what was planned")),
        module="requests",
    ),
    CommandSpec(
        "wait",
        "wait some seconds, or until the arm has come to rest",
        (
            ARM,
            SOCKET,
            option("seconds", type=finite, nargs="?", metavar="S", help="without it: until the arm rests"),
        ),
        module="requests",
    ),
    CommandSpec(
        "script",
        "run a file of operator lines: each a subcommand with its options",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="text, one line a command; - is standard input"),
            option("--check", action="store_true", help="only say what would be done; needs no runtime"),
            JSON,
        ),
        "Every line is understood before the first is run; it ends at the first that fails. A line that ends with & begins a"
        " motion and goes on; # begins a remark.",
    ),
    CommandSpec(
        "stop",
        "controlled stop, then hold: every runtime of this user, or one",
        (option("--arm", metavar="A", help="only this arm (default: all that run)"), SOCKET),
        "Needs no readable file: where --arm cannot be read, all are stopped. Exit status 1 when one did not answer or none"
        " runs.",
    ),
    CommandSpec(
        "guide",
        "drives off, to guide the arm by hand: somebody must hold it",
        (
            ARM,
            SOCKET,
            option(
                "--weightless",
                action="store_true",
                help="the drives carry the arm's weight; only as good as its masses and payload are known",
            ),
            option("--yes", action="store_true", help="somebody holds the arm: do not ask"),
        ),
        "Asks before it lets the arm go.",
        module="requests",
    ),
    CommandSpec("hold", "end hand-guiding and hold", (ARM, SOCKET), module="requests"),
    CommandSpec("acknowledge", "a human has seen the fault", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "off",
        "stop, hold, lower on shorted windings, drives off",
        (ARM, SOCKET, option("--quit", action="store_true", help="end the runtime too")),
        module="requests",
    ),
)
