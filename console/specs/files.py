"""Commands that read and convert files."""

from console.options import ARM, JSON, OUT, USERS_ARM, CommandSpec, option

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
        module="recordings.export",
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
