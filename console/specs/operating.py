"""Commands that run the arm through the runtime's socket."""

from console.options import ARM, CELL, JSON, LINKS, RATE, SOCKET, CommandSpec, finite, option

PLACES = option("--places FILE", "named places (default: places.toml)", default="places.toml")
MOVE_SPEED = option("--speed F", "fraction of the joints' limits (default: 0.5)", type=finite, default=0.5)
OPERATING = (
    CommandSpec(
        "serve",
        "run the arm: connect its boards and serve the local socket until stopped",
        (ARM, CELL, *LINKS, RATE, SOCKET, option("--log DIR", "folder of the recordings (default: log)", default="log")),
        "Drives stay off until `armwright enable`. Ctrl-C stops the arm, switches it off as `armwright off` does, and exits.",
    ),
    CommandSpec(
        "check", "find the boards in arm.toml and compare their identities; nothing moves", (ARM, *LINKS, JSON), module="serve"
    ),
    CommandSpec(
        "console",
        "full-screen console with keys to jog, move, teach and calibrate",
        (
            ARM,
            CELL,
            SOCKET,
            PLACES,
            option("--teach FILE", "way-points taught by hand (default: taught.csv)", default="taught.csv"),
            option("--keep FILE", "save every executed line for `armwright script`"),
            option("--sessions DIR", "calibration sessions (default: sessions)", default="sessions"),
        ),
        "Space always stops the arm. `?` shows the keys. The console is a client: `armwright serve` runs the arm.",
    ),
    CommandSpec(
        "status",
        "state of the arm, its warnings and faults",
        (ARM, SOCKET, option("--modes", "print all modes and what leads from one to another instead"), JSON),
    ),
    CommandSpec("enable", "turn the drives on and hold the present pose", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "home",
        "find every joint's zero",
        (ARM, SOCKET, option("--again", "home again even if the boards know their zeros")),
        "Nothing moves if all encoder boards still know their zeros.",
        module="requests",
    ),
    CommandSpec(
        "move",
        "move to joint angles or to a tip position",
        (
            ARM,
            SOCKET,
            option("--joints RAD", "joint angles in rad", type=finite, nargs="+"),
            option("--tip X Y Z", "tip position in m, in the arm's base frame", type=finite, nargs=3),
            option(
                "--frame",
                "with --tip: the arm's base frame, which no calibration moves (default), or that of the camera or tracker,"
                " where `calibrate` has found it",
                choices=("base", "tracker"),
                default="base",
            ),
            option(
                "--orientation QW QX QY QZ",
                "with --tip: orientation of the last link frame in that frame, a unit quaternion",
                type=finite,
                nargs=4,
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
            option("file FILE", "CSV with x_m,y_m,z_m and optionally qw,qx,qy,qz and speed_m_s"),
            option("--speed M_S", "one speed for all way-points, in m/s", type=finite),
            option(
                "--relative-to ARM", "way-points are offsets from this arm's tip, where it holds now, along the axes of the cell"
            ),
            option("--cell C", "with --relative-to: the cell.toml that `serve` runs (default: pair)", default="pair"),
            option("--plan-only", "check and print the plan from where the arm is; without a runtime from [rest], and says so"),
        ),
        "Everything is checked before anything moves: reach, joint limits, speed, acceleration, table.",
        module="moving",
    ),
    CommandSpec(
        "go",
        "move to a named place",
        (ARM, SOCKET, PLACES, option("name NAME", "name in the places file"), MOVE_SPEED),
        "The file is TOML: [NAME] with q_rad (one per joint) or tip_m (3).",
        module="moving",
    ),
    CommandSpec(
        "mark",
        "save the present pose as a named place",
        (ARM, SOCKET, PLACES, option("name NAME", "letters, digits, - and _")),
        module="moving",
    ),
    CommandSpec(
        "teach",
        "append the tip position to a way-point file",
        (
            ARM,
            SOCKET,
            option("file FILE", "CSV for `armwright run`; created if missing"),
            option("--orientation", "with the tip's orientation, in a new file"),
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
            option("file FILE", "a recording (.armlog) in which the arm was guided by hand"),
            option("--run N", "its run (default: the last one guided by hand)", type=int),
            option("--speed F", "fraction of the limits that the motion may use (default: 1)", type=finite, default=1.0),
            option("--plan-only", "check and print the plan; needs no runtime"),
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
            option("--joint J", "a joint, from 1", type=int),
            option("--axis", "along an axis; with r, about it", choices=("x", "y", "z", "rx", "ry", "rz")),
            option("--frame", "whose axis (default: base)", choices=("base", "tip"), default="base"),
            option("--by STEP", "rad for a joint or about an axis, m along an axis", type=finite, required=True),
            option("--speed V", "rad/s or m/s (default: the limit for jogging)", type=finite),
        ),
        "The arm stops at once if the command is interrupted. Exit status 1 if the step could not be completed.",
        module="moving",
    ),
    CommandSpec("pause", "slow to rest on the path and hold", (ARM, SOCKET), module="requests"),
    CommandSpec("resume", "continue the paused motion", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "override",
        "scale the speed of this and later motions",
        (ARM, SOCKET, option("fraction F", "0.01 to 1 of the planned speed", type=finite)),
        module="requests",
    ),
    CommandSpec(
        "wait",
        "wait some seconds, or until the arm is at rest",
        (ARM, SOCKET, option("seconds S", "default: until the arm is at rest", type=finite, nargs="?")),
        module="requests",
    ),
    CommandSpec(
        "script",
        "run a file of operator lines, each a subcommand with its options",
        (
            ARM,
            SOCKET,
            option("file FILE", "text, one command per line; - is standard input"),
            option("--check", "only print what would be done; needs no runtime"),
            JSON,
        ),
        "All lines are checked before the first one runs. The script ends at the first failure. A line that ends"
        " with & starts a motion without waiting; # starts a comment.",
    ),
    CommandSpec(
        "stop",
        "controlled stop, then hold, for every runtime of this user or one",
        (
            option("--arm A", "only this arm (default: all running arms)"),
            SOCKET,
            option("--take", "end another client's control, too: for one that hangs"),
        ),
        "Needs no valid file: if --arm cannot be read, all arms stop. Exit status 1 if a runtime does not answer or none runs.",
    ),
    CommandSpec(
        "guide",
        "turn the drives off to guide the arm by hand; somebody must hold it",
        (
            ARM,
            SOCKET,
            option("--weightless", "gravity compensation by the drives; only as good as the masses and the payload are known"),
            option("--yes", "do not ask: somebody holds the arm"),
        ),
        "Asks before it releases the arm. Stays until Enter, or until `armwright hold` or `stop` ends it from elsewhere; Ctrl-C"
        " shorts the windings.",
        module="requests",
    ),
    CommandSpec("hold", "end hand-guiding and hold", (ARM, SOCKET), module="requests"),
    CommandSpec("acknowledge", "acknowledge faults", (ARM, SOCKET), module="requests"),
    CommandSpec(
        "off",
        "stop, hold, let the arm sink on shorted windings, drives off",
        (
            ARM,
            SOCKET,
            option("--quit", "also end the runtime"),
            option("--yes", "do not ask: somebody holds an arm that its boards let go"),
        ),
        "Smart servos, ODrives and CiA 402 drives do not short them: the arm drops unless somebody holds it (docs/boards.md)."
        " One that its boards held when the runtime connected falls when they let go: asks before.",
        module="requests",
    ),
)


CELL_OF_CLIENT = option(
    "--cell C", "the cell.toml that `serve` runs, or the name of a supplied cell (default: pair)", default="pair"
)
CELLS = (
    CommandSpec(
        "together",
        "motions of several arms that begin and end together",
        (
            CELL_OF_CLIENT,
            option("--to ARM RAD", "joint angles of an arm in rad, as --to left 0.6 0.1 0.7", action="append", nargs="+"),
            option("--run ARM FILE", "way-points of an arm, as for `armwright run`", action="append", nargs=2),
            option(
                "--beside ARM OTHER FILE",
                "way-points of an arm from where OTHER's tip is at that moment; `keep` as FILE: as the tips are now",
                action="append",
                nargs=3,
            ),
            option("--speed F", "fraction of the joints' limits, with --to (default: 0.5)", type=finite, default=0.5),
        ),
        "Give --to, --run or --beside for each arm. All is checked before anything moves, the arms against each other too.",
        module="cell",
    ),
    CommandSpec(
        "follow",
        "one arm follows another, which a hand guides or a program moves",
        (
            CELL_OF_CLIENT,
            option("--leader ARM", "the arm that is guided or moved", required=True),
            option("--follower ARM", "the arm that follows, jogged", required=True),
            option("--mirrored", "as in a mirror halfway between the two bases (default: the same joint angles)"),
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
        (ARM, SOCKET, option("name NAME", "a [[tool]] of arm.toml (default: list them)", nargs="?"), JSON),
        "The tip, the masses and the collision checks change with it. The arm must be at rest.",
        module="end_effector",
    ),
    CommandSpec(
        "gripper",
        "open, close or stop the gripper, or go to an opening",
        (
            ARM,
            SOCKET,
            option("action", "default: print its state", choices=("open", "close", "stop"), nargs="?"),
            option("--to M", "an opening in m, 0 is closed", type=finite),
            option("--force N", "gripping force in N (default: force_N of arm.toml)", type=finite),
            option("--must-hold", "exit status 1 if it holds nothing at the end"),
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
            option("name NAME", "a [[digital]] of arm.toml (default: list them)", nargs="?"),
            option("level", "of an output", choices=LEVELS, nargs="?"),
            option("--until", "wait until the pin has this level", choices=LEVELS),
            option("--timeout S", "of --until (default: 10)", type=finite, default=10.0),
            JSON,
        ),
        "Outputs go to their safe levels when the arm goes to FAULT or its drives go off, and stay there until they are set.",
        module="end_effector",
    ),
)
