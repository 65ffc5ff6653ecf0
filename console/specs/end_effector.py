"""Commands for what is at the end of the arm."""

from console.options import ARM, JSON, SOCKET, CommandSpec, option

END_EFFECTOR = (
    CommandSpec(
        "tool",
        "say which tool is on, or list the tools",
        (
            ARM,
            SOCKET,
            option("name", metavar="NAME", nargs="?", help="a [[tool]] of arm.toml (default: list them)"),
            JSON,
        ),
        "The tip, the masses and what the arm must not meet change with it. The arm must be at rest.",
        module="end_effector",
    ),
)
