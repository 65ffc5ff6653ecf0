"""Commands that show recordings or the live arm, and completion for the shell."""

from console.options import CELL, JSON, SOCKET, CommandSpec, finite, option

LOG_HELP = "a .armlog recording, the folder of a cell's run, a log.csv(.gz), or an MCAP of `armwright export`"

VISUALISATION = (
    CommandSpec(
        "plot",
        "plot a recording: tracking, errors, currents, spectra, tip, cycle timing",
        (
            option("log", metavar="LOG", help=LOG_HELP),
            option(
                "--out",
                metavar="DIR|FILE",
                help="folder for PNG files, or one file.png, .svg or .pdf for all (default: out/plot)",
            ),
            option(
                "--what",
                metavar="W,...",
                help="tracking, errors, currents, voltages, supply, spectra, tip, lateness (default: all available)",
            ),
            option("--joints", metavar="J,...", help="joint numbers: 1,3 (default: all)"),
            option("--run", metavar="N", help="one run by number or name (default: all)"),
            option("--from", dest="from_s", type=finite, metavar="S", help="start time in s"),
            option("--to", dest="to_s", type=finite, metavar="S", help="end time in s"),
            option("--arm", metavar="A", help="the arm if the file names none: for limits and the tip"),
            option("--window", action="store_true", help="show windows and write nothing"),
            JSON,
        ),
        "Prints following errors, currents, saturation, tip error and cycle timing. --json without --out draws"
        " nothing. docs/visualisation.md.",
        module="recordings.plot",
    ),
    CommandSpec(
        "view",
        "show the arm in MuJoCo's viewer, recorded or live: commanded solid, measured as a ghost, with paths",
        (
            option("log", nargs="?", metavar="LOG", help=f"{LOG_HELP} (default: the live arm)"),
            option("--arm", metavar="A", help="the arm (default: the recorded one; live: right)"),
            CELL,
            SOCKET,
            option(
                "--speed", type=finite, default=1.0, metavar="X", help="playback speed factor (default: 1)"
            ),
            option("--run", metavar="N", help="one run by number or name (default: all)"),
            option("--from", dest="from_s", type=finite, metavar="S", help="start time in s"),
            option("--to", dest="to_s", type=finite, metavar="S", help="end time in s"),
            option(
                "--render",
                metavar="FILE|DIR",
                help="write FILE.png of the last sample, FILE.gif, or a folder of PNG files; needs no display",
            ),
            option(
                "--fps",
                type=finite,
                default=25.0,
                metavar="N",
                help="frames per second of --render (default: 25)",
            ),
            option(
                "--rerun",
                nargs="?",
                const="",
                metavar="FILE.rrd",
                help="send to a Rerun viewer or write a file; needs the extra `rerun` (docs/visualisation.md)",
            ),
            option(
                "--foxglove",
                nargs="?",
                const="",
                metavar="[HOST:]PORT",
                help="serve the live arm to Foxglove (default: 127.0.0.1:8765); needs the extra `foxglove`",
            ),
        ),
        "Moves nothing: the live view only asks the runtime for its status. docs/visualisation.md.",
        module="recordings.view",
    ),
    CommandSpec(
        "completion",
        "print a script that completes armwright's commands, options and files in your shell",
        (option("shell", choices=("bash", "zsh", "fish", "tcsh"), help="the shell"),),
        "docs/visualisation.md describes the installation.",
    ),
)
