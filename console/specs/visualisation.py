"""Commands that show what the arm did or does, and completion for the shell."""

from console.options import JSON, SOCKET, CommandSpec, finite, option

LOG_HELP = "a .armlog recording, a log.csv or log.csv.gz, or an MCAP of `armwright export`"

SEEING = (
    CommandSpec(
        "plot",
        "figures of a recording: tracking, errors, currents, spectra, tip, punctuality",
        (
            option("log", metavar="LOG", help=LOG_HELP),
            option(
                "--out",
                metavar="DIR|FILE",
                help="a folder for a PNG each, or one file.png, .svg or .pdf for all (default: out/plot)",
            ),
            option(
                "--what",
                metavar="W,...",
                help="tracking, errors, currents, voltages, supply, spectra, tip, lateness (default: all that there are)",
            ),
            option("--joints", metavar="J,...", help="joints by number: 1,3 (default: all)"),
            option("--run", metavar="N", help="one run by its number or name (default: all)"),
            option("--from", dest="from_s", type=finite, metavar="S", help="from this time on, in s"),
            option("--to", dest="to_s", type=finite, metavar="S", help="up to this time, in s"),
            option("--arm", metavar="A", help="the arm, where the file does not say: for limits and the tip"),
            option("--window", action="store_true", help="show windows and write nothing"),
            JSON,
        ),
        "Prints following errors, currents, saturation, tip error and punctuality; --json without --out draws nothing."
        " docs/visualisation.md.",
        module="recordings.plot",
    ),
    CommandSpec(
        "view",
        "the arm in MuJoCo's viewer, recorded or live: commanded solid, measured as a ghost, with their paths",
        (
            option("log", nargs="?", metavar="LOG", help=f"{LOG_HELP} (default: the arm as it moves now)"),
            option("--arm", metavar="A", help="the arm (default: the one that was recorded; live: right)"),
            SOCKET,
            option(
                "--speed", type=finite, default=1.0, metavar="X", help="times as fast as it was (default: 1)"
            ),
            option("--run", metavar="N", help="one run by its number or name (default: all)"),
            option("--from", dest="from_s", type=finite, metavar="S", help="from this time on, in s"),
            option("--to", dest="to_s", type=finite, metavar="S", help="up to this time, in s"),
            option(
                "--render",
                metavar="FILE|DIR",
                help="no window: FILE.png of the last moment, FILE.gif, or a folder with a PNG each; needs no display",
            ),
            option(
                "--fps",
                type=finite,
                default=25.0,
                metavar="N",
                help="pictures a second of --render (default: 25)",
            ),
            option(
                "--rerun",
                nargs="?",
                const="",
                metavar="FILE.rrd",
                help="to a Rerun viewer, or into a file; takes the extra `rerun` (docs/visualisation.md)",
            ),
        ),
        "Nothing moves by it: live it only asks the runtime for its status. docs/visualisation.md.",
        module="recordings.view",
    ),
    CommandSpec(
        "completion",
        "print a script that completes armwright's commands, options and files in your shell",
        (option("shell", choices=("bash", "zsh", "fish", "tcsh"), help="for which shell"),),
        "docs/visualisation.md says where to put it.",
    ),
)
