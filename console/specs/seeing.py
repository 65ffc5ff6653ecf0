"""Commands that show what the arm did or does, and completion for the shell."""

from console.options import JSON, CommandSpec, option

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
            option("--from", dest="from_s", type=float, metavar="S", help="from this time on, in s"),
            option("--to", dest="to_s", type=float, metavar="S", help="up to this time, in s"),
            option("--arm", metavar="A", help="the arm, where the file does not say: for limits and the tip"),
            option("--window", action="store_true", help="show windows and write nothing"),
            JSON,
        ),
        "Prints following errors, currents, saturation, tip error and punctuality; --json without --out draws nothing."
        " docs/seeing.md.",
    ),
)
