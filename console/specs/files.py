"""Commands that read and convert files, and that show recordings."""

from console.options import ARM, CELL, JSON, OUT, SOCKET, USERS_ARM, CommandSpec, finite, option

MODEL = (
    option("--from-urdf", metavar="F", help="take axes, masses and limits from a URDF file"),
    option("--from-mjcf", metavar="F", help="the same from MuJoCo's format"),
    option("--base", metavar="LINK", help="first link of the arm in the model (default: its root)"),
    option("--tip", metavar="LINK", help="last link of the arm in the model (default: its only end)"),
    option(
        "--as-given",
        action="store_true",
        help="the model means what it says: do not refuse it for what it looks like, such as grams",
    ),
    option(
        "--convention",
        choices=("standard", "modified"),
        default="standard",
        help="DH convention of the new file (default: standard)",
    ),
)

LEROBOT = option("--lerobot", metavar="JSON", help="LeRobot's calibration of this arm (docs/so101.md)")

FILES = (
    CommandSpec(
        "export",
        "convert a recording to log.csv.gz and MCAP, that of a cell to one table, or several to a LeRobot dataset",
        (
            option(
                "recording",
                metavar="LOG",
                nargs="+",
                help="a .armlog file, or the folder of a cell's run: cell.csv.gz; several files with --lerobot",
            ),
            OUT,
            option("--every", type=int, default=1, metavar="K", help="keep every k-th cycle (default: 1)"),
            option(
                "--arm",
                metavar="A",
                help="the arm for Foxglove's 3-D panel (default: the recorded one)",
            ),
            option(
                "--lerobot",
                action="store_true",
                help="write a LeRobot dataset instead, an episode per run; needs the extra `lerobot` (docs/extras.md)",
            ),
            option("--fps", type=int, metavar="N", help="samples per second of the dataset (default: 50)"),
            option("--task", metavar="TEXT", help="what the arm does in the dataset, in words"),
            JSON,
        ),
        module="recordings",
    ),
    CommandSpec(
        "export-arm",
        "export an arm as URDF, MJCF, JSON or Python, or its zeros as LeRobot's calibration",
        (
            ARM,
            option(
                "--export",
                required=True,
                choices=("urdf", "mjcf", "json", "python", "lerobot"),
                help="URDF, MuJoCo's MJCF, plain DH with transforms, a Python function that corrects joint angles, or LeRobot's"
                " calibration",
            ),
            LEROBOT,
            option(
                "--generic",
                metavar="A",
                help="the published arm, such as so101: with lerobot, whose zeros LeRobot is to have; with python, the one that a"
                " program plans with",
            ),
            option("--out", metavar="FILE", required=True, help="the new file; never overwritten"),
        ),
        "Lists what the format cannot represent. The joint angles are those of the arm.",
        module="arm",
    ),
    CommandSpec(
        "arm",
        "read an arm.toml and print a summary; or write one from a URDF or MJCF",
        (
            option(
                "arm",
                nargs="?",
                default=USERS_ARM,
                metavar="A",
                help="an arm.toml, or the name of a supplied arm (default: as for --arm of other commands)",
            ),
            option(
                "--keys",
                nargs="?",
                const="",
                metavar="SECTION",
                help="print every key of an arm.toml with its unit and default instead, or those of a section such as drive.home",
            ),
            JSON,
            *MODEL,
            LEROBOT,
            option(
                "--out",
                metavar="NEW.toml",
                help="with a model or --lerobot: the arm.toml to write; never overwritten",
            ),
        ),
        "--lerobot takes zeros and ranges over. With --from-urdf or --from-mjcf, motors, gears, encoders and boards are"
        " placeholders; `armwright new` asks for them.",
    ),
)


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
        module="recordings",
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
        module="view",
    ),
    CommandSpec(
        "completion",
        "print a script that completes armwright's commands, options and files in your shell",
        (option("shell", choices=("bash", "zsh", "fish", "tcsh"), help="the shell"),),
        "docs/visualisation.md describes the installation.",
    ),
)
