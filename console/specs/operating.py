"""Commands that run the arm through the runtime's socket."""

from console.options import ARM, CELL, JSON, LINKS, RATE, SOCKET, CommandSpec, finite, option

PLACES = option("--places", metavar="FILE", default="places.toml", help="named places (default: places.toml)")
MOVE_SPEED = option(
    "--speed", type=finite, default=0.5, metavar="F", help="fraction of the joints' limits (default: 0.5)"
)
OPERATING = (
    CommandSpec(
        "serve",
        "run the arm: connect its boards and serve the local socket until stopped",
        (
            ARM,
            CELL,
            *LINKS,
            RATE,
            SOCKET,
            option("--log", metavar="DIR", default="log", help="folder of the recordings (default: log)"),
        ),
        (
            "Drives stay off until `armwright enable`. Ctrl-C stops the arm, holds it, lowers it on shorted windings and"
            " exits."
        ),
    ),
    CommandSpec(
        "check",
        "find the boards in arm.toml and compare their identities; nothing moves",
        (ARM, *LINKS, JSON),
        module="serve",
    ),
    CommandSpec(
        "console",
        "full-screen console with keys to jog, move, teach and calibrate",
        (
            ARM,
            CELL,
            SOCKET,
            PLACES,
            option(
                "--teach",
                metavar="FILE",
                default="taught.csv",
                help="way-points taught by hand (default: taught.csv)",
            ),
            option("--keep", metavar="FILE", help="save every executed line for `armwright script`"),
            option(
                "--sessions",
                metavar="DIR",
                default="sessions",
                help="calibration sessions (default: sessions)",
            ),
        ),
        "Space always stops the arm. `?` shows the keys. The console is a client: `armwright serve` runs the arm.",
    ),
    CommandSpec(
        "status",
        "state of the arm, its warnings and faults",
        (
            ARM,
            SOCKET,
            option(
                "--modes",
                action="store_true",
                help="print all modes and what leads from one to another instead",
            ),
            JSON,
        ),
    ),
    CommandSpec("enable", "turn the drives on and hold the present pose", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "home",
        "find every joint's zero",
        (
            ARM,
            SOCKET,
            option("--again", action="store_true", help="home again even if the boards know their zeros"),
        ),
        "Nothing moves if all encoder boards still know their zeros.",
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
                help="tip position in m, in the arm's base frame",
            ),
            option(
                "--frame",
                choices=("base", "tracker"),
                default="base",
                help="with --tip: the arm's base frame, which no calibration moves (default), or that of the camera or tracker,"
                " where `calibrate` has found it",
            ),
            option(
                "--orientation",
                type=finite,
                nargs=4,
                metavar=("QW", "QX", "QY", "QZ"),
                help="with --tip: orientation of the last link frame in that frame, a unit quaternion",
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
            option(
                "file", metavar="FILE", help="CSV with x_m,y_m,z_m and optionally qw,qx,qy,qz and speed_m_s"
            ),
            option("--speed", type=finite, metavar="M_S", help="one speed for all way-points, in m/s"),
            option(
                "--relative-to",
                metavar="ARM",
                help="way-points are offsets from this arm's tip, where it holds now, along the axes of the cell",
            ),
            option(
                "--cell",
                metavar="C",
                default="pair",
                help="with --relative-to: the cell.toml that `serve` runs (default: pair)",
            ),
            option(
                "--plan-only",
                action="store_true",
                help="check and print the plan from where the arm is; without a runtime from [rest], and says so",
            ),
        ),
        "Everything is checked before anything moves: reach, joint limits, speed, acceleration, table.",
        module="moving",
    ),
    CommandSpec(
        "go",
        "move to a named place",
        (ARM, SOCKET, PLACES, option("name", metavar="NAME", help="name in the places file"), MOVE_SPEED),
        "The file is TOML: [NAME] with q_rad (one per joint) or tip_m (3).",
        module="moving",
    ),
    CommandSpec(
        "mark",
        "save the present pose as a named place",
        (ARM, SOCKET, PLACES, option("name", metavar="NAME", help="letters, digits, - and _")),
        module="moving",
    ),
    CommandSpec(
        "teach",
        "append the tip position to a way-point file",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="CSV for `armwright run`; created if missing"),
            option("--orientation", action="store_true", help="with the tip's orientation, in a new file"),
        ),
        (
            "Guide the arm by hand (`armwright guide`), teach, repeat; then `armwright hold`. `run` moves gently to the"
            " first point."
        ),
        module="moving",
    ),
    CommandSpec(
        "replay",
        "repeat a hand-guided motion of a recording, smoothed and within limits",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="a recording (.armlog) in which the arm was guided by hand"),
            option("--run", type=int, metavar="N", help="its run (default: the last one guided by hand)"),
            option(
                "--speed",
                type=finite,
                default=1.0,
                metavar="F",
                help="fraction of the limits that the motion may use (default: 1)",
            ),
            option("--plan-only", action="store_true", help="check and print the plan; needs no runtime"),
        ),
        "It takes longer where the hand was faster than the limits.",
        module="script",
    ),
    CommandSpec(
        "jog",
        "move a joint, or the tip along or about an axis of the base or of the tip, by one step",
        (
            ARM,
            SOCKET,
            option("--joint", type=int, metavar="J", help="a joint, from 1"),
            option(
                "--axis", choices=("x", "y", "z", "rx", "ry", "rz"), help="along an axis; with r, about it"
            ),
            option("--frame", choices=("base", "tip"), default="base", help="whose axis (default: base)"),
            option(
                "--by",
                type=finite,
                required=True,
                metavar="STEP",
                help="rad for a joint or about an axis, m along an axis",
            ),
            option("--speed", type=finite, metavar="V", help="rad/s or m/s (default: the limit for jogging)"),
        ),
        "The arm stops at once if the command is interrupted. Exit status 1 if the step could not be completed.",
        module="moving",
    ),
    CommandSpec("pause", "slow to rest on the path and hold", (ARM, SOCKET), module="requests"),
    CommandSpec("resume", "continue the paused motion", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "override",
        "scale the speed of this and later motions",
        (ARM, SOCKET, option("fraction", type=finite, metavar="F", help="0.01 to 1 of the planned speed")),
        module="requests",
    ),
    CommandSpec(
        "wait",
        "wait some seconds, or until the arm is at rest",
        (
            ARM,
            SOCKET,
            option("seconds", type=finite, nargs="?", metavar="S", help="default: until the arm is at rest"),
        ),
        module="requests",
    ),
    CommandSpec(
        "script",
        "run a file of operator lines, each a subcommand with its options",
        (
            ARM,
            SOCKET,
            option("file", metavar="FILE", help="text, one command per line; - is standard input"),
            option("--check", action="store_true", help="only print what would be done; needs no runtime"),
            JSON,
        ),
        "All lines are checked before the first one runs. The script ends at the first failure. A line that ends"
        " with & starts a motion without waiting; # starts a comment.",
    ),
    CommandSpec(
        "stop",
        "controlled stop, then hold, for every runtime of this user or one",
        (
            option("--arm", metavar="A", help="only this arm (default: all running arms)"),
            SOCKET,
            option(
                "--take", action="store_true", help="end another client's control, too: for one that hangs"
            ),
        ),
        "Needs no valid file: if --arm cannot be read, all arms stop. Exit status 1 if a runtime does not answer or"
        " none runs.",
    ),
    CommandSpec(
        "guide",
        "turn the drives off to guide the arm by hand; somebody must hold it",
        (
            ARM,
            SOCKET,
            option(
                "--weightless",
                action="store_true",
                help="gravity compensation by the drives; only as good as the masses and the payload are known",
            ),
            option("--yes", action="store_true", help="do not ask: somebody holds the arm"),
        ),
        "Asks before it releases the arm. Stays until Enter, or until `armwright hold` or `stop` ends it from elsewhere; Ctrl-C"
        " shorts the windings.",
        module="requests",
    ),
    CommandSpec("hold", "end hand-guiding and hold", (ARM, SOCKET), module="requests"),
    CommandSpec("acknowledge", "acknowledge faults", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "off",
        "stop, hold, lower on shorted windings, drives off",
        (
            ARM,
            SOCKET,
            option("--quit", action="store_true", help="also end the runtime"),
            option(
                "--yes", action="store_true", help="do not ask: somebody holds an arm that its boards let go"
            ),
        ),
        "An arm that its boards held when the runtime connected falls when they let go: asks before.",
        module="requests",
    ),
)


CELL_OF_CLIENT = option(
    "--cell",
    metavar="C",
    default="pair",
    help="the cell.toml that `serve` runs, or the name of a supplied cell (default: pair)",
)
CELLS = (
    CommandSpec(
        "together",
        "motions of several arms that begin and end together",
        (
            CELL_OF_CLIENT,
            option(
                "--to",
                action="append",
                nargs="+",
                metavar=("ARM", "RAD"),
                help="joint angles of an arm in rad, as --to left 0.6 0.1 0.7",
            ),
            option(
                "--run",
                action="append",
                nargs=2,
                metavar=("ARM", "FILE"),
                help="way-points of an arm, as for `armwright run`",
            ),
            option(
                "--beside",
                action="append",
                nargs=3,
                metavar=("ARM", "OTHER", "FILE"),
                help="way-points of an arm from where OTHER's tip is at that moment; `keep` as FILE: as the tips are now",
            ),
            option(
                "--speed",
                type=finite,
                default=0.5,
                metavar="F",
                help="fraction of the joints' limits, with --to (default: 0.5)",
            ),
        ),
        "Give --to, --run or --beside for each arm. All is checked before anything moves, the arms against each other too.",
        module="cell",
    ),
    CommandSpec(
        "follow",
        "one arm follows another, which a hand guides or a program moves",
        (
            CELL_OF_CLIENT,
            option("--leader", required=True, metavar="ARM", help="the arm that is guided or moved"),
            option("--follower", required=True, metavar="ARM", help="the arm that follows, jogged"),
            option(
                "--mirrored",
                action="store_true",
                help="as in a mirror halfway between the two bases (default: the same joint angles)",
            ),
        ),
        "The follower first moves to where the leader is. It keeps to the limits of jogs, and away from the other arm.",
        module="cell",
    ),
)


LEVELS = ("on", "off")
END_EFFECTOR = (
    CommandSpec(
        "tool",
        "state which tool is mounted, or list the tools",
        (
            ARM,
            SOCKET,
            option("name", metavar="NAME", nargs="?", help="a [[tool]] of arm.toml (default: list them)"),
            JSON,
        ),
        "The tip, the masses and the collision checks change with it. The arm must be at rest.",
        module="end_effector",
    ),
    CommandSpec(
        "gripper",
        "open, close or stop the gripper, or go to an opening",
        (
            ARM,
            SOCKET,
            option("action", choices=("open", "close", "stop"), nargs="?", help="default: print its state"),
            option("--to", type=finite, metavar="M", help="an opening in m, 0 is closed"),
            option(
                "--force", type=finite, metavar="N", help="gripping force in N (default: force_N of arm.toml)"
            ),
            option("--must-hold", action="store_true", help="exit status 1 if it holds nothing at the end"),
            JSON,
        ),
        "Returns when it has come to its end, or holds something. It stops with Ctrl-C, and with `armwright stop`.",
        module="end_effector",
    ),
    CommandSpec(
        "digital",
        "set an output, wait for an input, or list the pins",
        (
            ARM,
            SOCKET,
            option("name", metavar="NAME", nargs="?", help="a [[digital]] of arm.toml (default: list them)"),
            option("level", choices=LEVELS, nargs="?", help="of an output"),
            option("--until", choices=LEVELS, help="wait until the pin has this level"),
            option("--timeout", type=finite, default=10.0, metavar="S", help="of --until (default: 10)"),
            JSON,
        ),
        "Outputs go to their safe levels when the arm goes to FAULT or its drives go off, and stay there until they are set.",
        module="end_effector",
    ),
)
