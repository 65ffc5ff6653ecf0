"""Commands that plan with what is known of an arm's error."""

from console.options import ARM, AS_GIVEN, BOARDS, JSON, CommandSpec, finite, option, payload, points

PLANNING = (
    CommandSpec(
        "plan-path",
        "plan a path, or stops, for the least expected tip error: place, branch, side of approach, order, speed",
        (
            ARM,
            option("file", metavar="FILE", help="way-points as for `armwright run`"),
            points("points.csv or .csv.gz of the real arm: what is known of its error", is_required=True),
            AS_GIVEN,
            option("--out", metavar="DIR", required=True, help="folder for the results; created if missing"),
            option(
                "--stops",
                action="store_true",
                help="the arm stops at every way-point, and each is approached on its own",
            ),
            option(
                "--any-order",
                action="store_true",
                help="the way-points may be visited in another order; a path backwards",
            ),
            option(
                "--shift",
                type=finite,
                nargs=3,
                metavar=("X", "Y", "Z"),
                help="how far the work may be moved along x, y, z of the base frame, either way, in m (default: not at all)",
            ),
            option("--tolerance", metavar="LENGTH", help="e.g. 0.5mm: also say how probably it is kept"),
            payload("mass at the tip (default: 0)"),
            BOARDS,
            JSON,
        ),
        "Nothing moves. Writes path.csv or poses.csv, script.txt and task.json; docs/plan_path.md.",
        module="calibration.plan_path",
    ),
)
