"""Commands that read and convert files, and that show recordings."""

from console.options import ARM, CELL, JSON, OUT, SOCKET, USERS_ARM, CommandSpec, finite, option

MODEL = (
    option("--from-urdf F", "take axes, masses and limits from a URDF file"),
    option("--from-mjcf F", "the same from MuJoCo's format"),
    option("--base LINK", "first link of the arm in the model (default: its root)"),
    option("--tip LINK", "last link of the arm in the model (default: its only end)"),
    option("--as-given", "the model means what it says: do not refuse it for what it looks like, such as grams"),
    option(
        "--convention", "DH convention of the new file (default: standard)", choices=("standard", "modified"), default="standard"
    ),
)

LEROBOT = option("--lerobot JSON", "LeRobot's calibration of this arm (docs/so101.md)")

FILES = (
    CommandSpec(
        "export",
        "convert a recording to log.csv.gz and MCAP, that of a cell to one table, or several to a LeRobot dataset",
        (
            option(
                "recording LOG",
                "a .armlog file, or the folder of a cell's run: cell.csv.gz; several files with --lerobot",
                nargs="+",
            ),
            OUT,
            option("--every K", "keep every k-th cycle (default: 1)", type=int, default=1),
            option("--arm A", "the arm for Foxglove's 3-D panel (default: the recorded one)"),
            option(
                "--lerobot", "write a LeRobot dataset instead, an episode per run; needs the extra `lerobot` (docs/extras.md)"
            ),
            option("--fps N", "samples per second of the dataset (default: 50)", type=int),
            option("--task TEXT", "what the arm does in the dataset, in words"),
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
                "URDF, MuJoCo's MJCF, plain DH with transforms, a Python function that corrects joint angles, or LeRobot's"
                " calibration",
                required=True,
                choices=("urdf", "mjcf", "json", "python", "lerobot"),
            ),
            LEROBOT,
            option(
                "--generic A",
                "the published arm, such as so101: with lerobot, whose zeros LeRobot is to have; with python, the one that a"
                " program plans with",
            ),
            option(
                "--served",
                "urdf, mjcf, json: for a program that moves the arm through `serve`, which corrects play and other effects: the"
                " links as the file has them (default: those of the rigid arm that is nearest with its effects)",
            ),
            option("--out FILE", "the new file; never overwritten", required=True),
        ),
        "Lists what the format cannot represent. The joint angles are those of the arm.",
        module="arm",
    ),
    CommandSpec(
        "arm",
        "read an arm.toml and print a summary; or write one from a URDF or MJCF",
        (
            option(
                "arm A",
                "an arm.toml, or the name of a supplied arm (default: as for --arm of other commands)",
                nargs="?",
                default=USERS_ARM,
            ),
            option(
                "--keys SECTION",
                "print every key of an arm.toml with its unit and default instead, or those of a section such as drive.home; of"
                " other files: cell, scenario (of a mock), tolerances, armlog (the columns of a recording)",
                nargs="?",
                const="",
            ),
            JSON,
            *MODEL,
            LEROBOT,
            option("--out NEW.toml", "with a model or --lerobot: the arm.toml to write; never overwritten"),
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
            option("log LOG", LOG_HELP),
            option("--out DIR|FILE", "folder for PNG files, or one file.png, .svg or .pdf for all (default: out/plot)"),
            option(
                "--what W,...", "tracking, errors, currents, voltages, supply, spectra, tip, lateness (default: all available)"
            ),
            option("--joints J,...", "joint numbers: 1,3 (default: all)"),
            option("--run N", "one run by number or name (default: all)"),
            option("--from S", "start time in s", dest="from_s", type=finite),
            option("--to S", "end time in s", dest="to_s", type=finite),
            option("--arm A", "the arm if the file names none: for limits and the tip"),
            option("--window", "show windows and write nothing"),
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
            option("log LOG", f"{LOG_HELP} (default: the live arm)", nargs="?"),
            option("--arm A", "the arm (default: the recorded one; live: right)"),
            CELL,
            SOCKET,
            option("--speed X", "playback speed factor (default: 1)", type=finite, default=1.0),
            option("--run N", "one run by number or name (default: all)"),
            option("--from S", "start time in s", dest="from_s", type=finite),
            option("--to S", "end time in s", dest="to_s", type=finite),
            option(
                "--render FILE|DIR", "write FILE.png of the last sample, FILE.gif, or a folder of PNG files; needs no display"
            ),
            option("--fps N", "frames per second of --render (default: 25)", type=finite, default=25.0),
            option(
                "--rerun FILE.rrd",
                "send to a Rerun viewer or write a file; needs the extra `rerun` (docs/visualisation.md)",
                nargs="?",
                const="",
            ),
            option(
                "--foxglove [HOST:]PORT",
                "serve the live arm to Foxglove (default: 127.0.0.1:8765); needs the extra `foxglove`",
                nargs="?",
                const="",
            ),
        ),
        "Moves nothing: the live view only asks the runtime for its status. docs/visualisation.md.",
        module="view",
    ),
    CommandSpec(
        "completion",
        "print a script that completes armwright's commands, options and files in your shell",
        (option("shell", "the shell", choices=("bash", "zsh", "fish", "tcsh")),),
        "docs/visualisation.md describes the installation.",
    ),
)
