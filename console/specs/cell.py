"""Commands for several arms of one cell."""

from console.options import CommandSpec, finite, option

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
        module="cell.together",
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
        module="cell.follow",
    ),
)
