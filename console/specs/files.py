"""Commands that read and convert files."""

from console.options import ARM, JSON, OUT, USERS_ARM, CommandSpec, option

FILES = (
    CommandSpec(
        "export",
        "convert a recording to log.csv.gz and MCAP",
        (
            option("recording", metavar="FILE", help="a .armlog file"),
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
        "read an arm.toml and print a summary",
        (option("arm", nargs="?", default=USERS_ARM, metavar="A"), JSON),
    ),
)
