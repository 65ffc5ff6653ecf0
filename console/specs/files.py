"""Commands that read and turn files."""

from console.options import ARM, JSON, OUT, USERS_ARM, CommandSpec, option

FILES = (
    CommandSpec(
        "export",
        "turn a recording into log.csv.gz and MCAP",
        (
            option("recording", metavar="FILE", help="a .armlog file"),
            OUT,
            option("--every", type=int, default=1, metavar="K", help="keep every k-th cycle (default: 1)"),
            option(
                "--arm",
                metavar="A",
                help="the arm that Foxglove's 3-D panel shows (default: the one that was recorded)",
            ),
            JSON,
        ),
        module="recordings.export",
    ),
    CommandSpec(
        "export-arm",
        "write an arm as URDF, MJCF or JSON for other tools",
        (
            ARM,
            option(
                "--export",
                required=True,
                choices=("urdf", "mjcf", "json"),
                help="the form: URDF, MuJoCo's MJCF, or plain DH with transforms",
            ),
            option("--out", metavar="FILE", required=True, help="a new file; none is overwritten"),
        ),
        "Says what the form cannot hold. A joint angle of the exported model is the arm's own.",
        module="arm",
    ),
    CommandSpec(
        "arm",
        "read an arm.toml and say what it holds",
        (option("arm", nargs="?", default=USERS_ARM, metavar="A"), JSON),
    ),
)
