"""Commands that read and convert files."""

from console.options import ARM, JSON, OUT, USERS_ARM, CommandSpec, option

MODEL = (
    option("--from-urdf", metavar="F", help="take axes, masses and limits from a URDF file"),
    option("--from-mjcf", metavar="F", help="the same from MuJoCo's format"),
    option("--base", metavar="LINK", help="first link of the arm in the model (default: its root)"),
    option("--tip", metavar="LINK", help="last link of the arm in the model (default: its only end)"),
    option(
        "--convention",
        choices=("standard", "modified"),
        default="standard",
        help="DH convention of the new file (default: standard)",
    ),
)

FILES = (
    CommandSpec(
        "export",
        "convert a recording to log.csv.gz and MCAP, or that of a cell to one table",
        (
            option(
                "recording", metavar="LOG", help="a .armlog file, or the folder of a cell's run: cell.csv.gz"
            ),
            OUT,
            option("--every", type=int, default=1, metavar="K", help="keep every k-th cycle (default: 1)"),
            option(
                "--arm",
                metavar="A",
                help="the arm for Foxglove's 3-D panel (default: the recorded one)",
            ),
            JSON,
        ),
        module="recordings.export",
    ),
    CommandSpec(
        "export-arm",
        "export an arm as URDF, MJCF or JSON",
        (
            ARM,
            option(
                "--export",
                required=True,
                choices=("urdf", "mjcf", "json"),
                help="URDF, MuJoCo's MJCF, or plain DH with transforms",
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
            JSON,
            *MODEL,
            option(
                "--out", metavar="NEW.toml", help="with a model: the arm.toml to write; never overwritten"
            ),
        ),
        "With --from-urdf or --from-mjcf, motors, gears, encoders and boards are placeholders; `armwright new` asks for them.",
    ),
)
