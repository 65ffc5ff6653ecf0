"""Commands for what is at the end of the arm."""

from console.options import ARM, JSON, SOCKET, CommandSpec, finite, option

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
