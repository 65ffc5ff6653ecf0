"""Targets that a camera sees: ChArUco boards and tags, their print, and their corners in pictures (OpenCV)."""

from __future__ import annotations

import importlib
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.errors import VisionError
from calib.points.points import IMPORT, ORIENTATION, TIP
from calib.points.writer import replace_file
from control.files import read_bytes
from control.kinematics.rotation import matrices
from control.plain_text import Advance, silent
from control.tables import TableColumn, TableFormat, read_table

Picture = npt.NDArray[np.uint8]
ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
PICTURE_MOST_px = 50_000_000  # of 8 bits; a picture beyond it is no camera's
PICTURE_MOST_bytes = 64 << 20


def opencv() -> Any:
    """The module cv2. VisionError with the remedy where it is not installed."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PICTURE_MOST_px))  # before a header that lies takes the memory
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # a damaged picture is said in one sentence
    try:
        module = importlib.import_module("cv2")
    except ImportError as error:
        raise VisionError(
            f"pictures are read by OpenCV, which cannot be imported ({error}): pip install 'armwright[camera]',"
            " or pip install opencv-python-headless"
        ) from error
    module.setNumThreads(1)  # the control loop may run beside it
    return module


def picture_files(folder: Path) -> list[Path]:
    """The pictures of a folder by name. VisionError if there are none."""
    if not folder.is_dir():
        raise VisionError(f"{folder}: expected a folder with pictures ({', '.join(ENDINGS)})")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in ENDINGS and file.is_file())
    if not files:
        raise VisionError(f"{folder}: holds no picture: expected files ending in {', '.join(ENDINGS)}")
    return files


def png_of(picture: Picture) -> bytes:
    """A grey picture as a PNG file."""
    return bytes(opencv().imencode(".png", picture)[1])


def read_picture(file: Path) -> Picture:
    """The grey picture (height, width) of a file, as the sensor gave it: a turn stated in EXIF is not applied. VisionError."""
    cv2 = opencv()
    try:
        content = np.frombuffer(read_bytes(file, PICTURE_MOST_bytes), np.uint8)
    except OSError as error:
        raise VisionError(f"{file}: cannot be read: {error.strerror}") from error
    try:
        picture = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        picture = None
    if picture is None or picture.size > PICTURE_MOST_px:
        raise VisionError(f"{file}: not a picture that OpenCV can read: save it as PNG or JPEG")
    return np.asarray(picture, dtype=np.uint8)


# Printed targets: a ChArUco board, or AprilTags at known places of one body. Their corners in the target's own frame.
#
# A board's frame has its origin at the board's centre, x along its rows to the right, y down, z into the print, as OpenCV's. The
# centre decouples the errors of position and orientation.


BOARD_DICTIONARY = "4x4_250"
TAG_DICTIONARY = "apriltag_36h11"
MARKER_SHARE = 0.75  # of a square, where nobody says: what common generators print
FAR_OFF = 5.0  # noises of one axis: a corner that was found beside its place, of which a board has one in fifty
SQUARES_MOST = 50
TAGS = TableFormat(
    "tag",
    (
        TableColumn("tag", "its number in the dictionary", is_required=True, is_whole=True, lower=0.0, upper=1e6),
        TableColumn("size_m", "edge of its black square", is_required=True, lower=1e-9, expected="a length above 0"),
        *(TableColumn(name, "its centre in the body's frame", is_required=True) for name in TIP),
        *(TableColumn(name, "its orientation in the body's frame; empty: as the body's") for name in ORIENTATION),
    ),
    unwarned=".*",
    separated=IMPORT,
)


@dataclass(frozen=True, slots=True)
class SeenCorners:
    """Corners of a target that a picture shows: target_m (k, 3) in its frame, and picture_px (k, 2)."""

    target_m: Array
    picture_px: Array

    def __len__(self) -> int:
        """How many corners."""
        return len(self.target_m)

    def agreeing(self, error_px: Array, noise_px: float, least: int) -> SeenCorners:
        """Those whose residual (k, 2) is not far above the noise; all, if fewer than `least` are."""
        keep = np.linalg.norm(error_px, axis=1) <= FAR_OFF * noise_px
        return SeenCorners(frozen(self.target_m[keep]), frozen(self.picture_px[keep])) if keep.sum() >= least else self


class PrintedTarget(Protocol):
    """Anything printed whose corners are known."""

    @property
    def name(self) -> str:
        """For messages and files."""

    @property
    def is_flat(self) -> bool:
        """Whether all its corners are in one plane."""

    @property
    def count(self) -> int:
        """How many corners it has."""

    @property
    def others(self) -> Mapping[str, PrintedTarget]:
        """What the print may be instead, by the option that says so."""

    def find(self, picture: Picture) -> SeenCorners:
        """The corners that a picture shows; none if it does not show the target."""


@dataclass(frozen=True, slots=True)
class Charuco:
    """A ChArUco board of columns by rows squares; `is_legacy`: printed by OpenCV before 4.6."""

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = BOARD_DICTIONARY
    is_legacy: bool = False

    def __post_init__(self) -> None:
        """VisionError for a board that cannot be printed."""
        if not (3 <= self.columns <= SQUARES_MOST and 3 <= self.rows <= SQUARES_MOST):
            raise VisionError(f"--board {self.columns}x{self.rows}: expected 3 to {SQUARES_MOST} squares a side, such as 5x7")
        if not 0.0 < self.marker_m < self.square_m:
            raise VisionError(
                f"--marker: expected a length between 0 and the square's {1e3 * self.square_m:g} mm, got"
                f" {1e3 * self.marker_m:g} mm"
            )
        words = _dictionary(self.dictionary).bytesList.shape[0]
        if self.columns * self.rows // 2 > words:
            raise VisionError(
                f"--board {self.columns}x{self.rows}: needs {self.columns * self.rows // 2} markers, dictionary {self.dictionary}"
                f" has {words}"
            )

    @property
    def name(self) -> str:
        """For messages and files."""
        return f"ChArUco {self.columns}x{self.rows}, squares {1e3 * self.square_m:g} mm"

    @property
    def is_flat(self) -> bool:
        """Always."""
        return True

    @property
    def count(self) -> int:
        """Inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def others(self) -> Mapping[str, PrintedTarget]:
        """The other layout of the markers, and the board lying on its side."""
        legacy = "without --legacy" if self.is_legacy else "with --legacy"
        turned = f"with --board {self.rows}x{self.columns}"
        layouts: dict[str, PrintedTarget] = {legacy: replace(self, is_legacy=not self.is_legacy)}
        if self.rows != self.columns:
            layouts[turned] = replace(self, columns=self.rows, rows=self.columns)
        return layouts

    @property
    def print_m(self) -> tuple[float, float]:
        """Width and height of the print without its margin."""
        return self.columns * self.square_m, self.rows * self.square_m

    def drawn(self, dots_m: float, margin_m: float) -> Picture:
        """The board with a white margin as a picture to print, of `dots_m` dots a metre."""
        margin = round(margin_m * dots_m)
        width, height = (round(size * dots_m) for size in self.print_m)
        size = (width + 2 * margin, height + 2 * margin)
        return np.asarray(self._board().generateImage(size, marginSize=margin), dtype=np.uint8)

    def find(self, picture: Picture) -> SeenCorners:
        """The inner corners that a picture shows, refined below a pixel."""
        cv2 = opencv()
        detector = cv2.aruco.CharucoDetector(self._board())
        detector.setDetectorParameters(_refined(cv2))
        pixels, ids, _, _ = detector.detectBoard(picture)
        if ids is None or len(ids) == 0:
            return NOTHING
        column, row = np.divmod(np.asarray(ids).ravel(), self.columns - 1)[::-1]
        flat = np.column_stack((column + 1.0 - 0.5 * self.columns, row + 1.0 - 0.5 * self.rows, 0.0 * row))
        return SeenCorners(frozen(flat * self.square_m), frozen(np.asarray(pixels, float).reshape(-1, 2)))

    def _board(self) -> Any:
        board = opencv().aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, _dictionary(self.dictionary))
        board.setLegacyPattern(self.is_legacy)
        return board


@dataclass(frozen=True, slots=True)
class Tags:
    """Tags of a rigid body: corners (4, 3) of each by its number, clockwise from the upper left, in the body's frame."""

    corners_m: Mapping[int, Array]
    dictionary: str = TAG_DICTIONARY

    @classmethod
    def single(cls, number: int, size_m: float, dictionary: str = TAG_DICTIONARY) -> Tags:
        """One tag, whose centre is the origin; size_m: edge of its black square."""
        if size_m <= 0.0:
            raise VisionError(f"--size: expected the edge of the tag's black square, above 0, got {size_m} m")
        return cls({_checked_number(number, dictionary, "--tag"): _square(size_m)}, dictionary)

    @property
    def name(self) -> str:
        """For messages and files."""
        return f"{self.dictionary} tag{'s' if len(self.corners_m) > 1 else ''} {', '.join(map(str, self.corners_m))}"

    @property
    def is_flat(self) -> bool:
        """Whether all tags are in one plane."""
        whole = np.concatenate(list(self.corners_m.values()))
        singular = np.linalg.svd(whole - whole.mean(axis=0), compute_uv=False)
        return bool(singular[2] < 1e-3 * singular[1])

    @property
    def print_m(self) -> tuple[float, float]:
        """Width and height of the print of a single tag without its margin."""
        (corners,) = self.corners_m.values()
        size = float(np.linalg.norm(corners[1] - corners[0]))
        return size, size

    def drawn(self, dots_m: float, margin_m: float) -> Picture:
        """A single tag with a white margin as a picture to print, of `dots_m` dots a metre."""
        (number,) = self.corners_m
        size, margin = round(self.print_m[0] * dots_m), round(margin_m * dots_m)
        image = opencv().aruco.generateImageMarker(_dictionary(self.dictionary), number, size)
        return np.pad(np.asarray(image, dtype=np.uint8), margin, constant_values=255)

    @property
    def others(self) -> Mapping[str, PrintedTarget]:
        """None: a tag has its number in it."""
        return {}

    @property
    def count(self) -> int:
        """Four a tag."""
        return 4 * len(self.corners_m)

    def find(self, picture: Picture) -> SeenCorners:
        """The corners of those tags that a picture shows."""
        # AprilTag's own search for squares finds near tags that contours miss, and takes forty times as long.
        for method in ("SUBPIX", "APRILTAG"):
            seen = self._detected(picture, method)
            if seen:
                corners_px = [refined_square(picture, found) for found in seen.values()]
                return SeenCorners(
                    frozen(np.concatenate([self.corners_m[number] for number in seen])), frozen(np.concatenate(corners_px))
                )
        return NOTHING

    def _detected(self, picture: Picture, method: str) -> dict[int, Array]:
        """Corners (4, 2) of our tags, by their numbers, as one of OpenCV's searches finds them."""
        cv2 = opencv()
        detector = cv2.aruco.ArucoDetector(_dictionary(self.dictionary), _refined(cv2, method))
        pixels, ids, _ = detector.detectMarkers(picture)
        numbers = [] if ids is None else np.asarray(ids).ravel().tolist()
        return {
            number: np.asarray(corners, float).reshape(4, 2)
            for number, corners in zip(numbers, pixels, strict=True)
            if number in self.corners_m and numbers.count(number) == 1
        }


NOTHING = SeenCorners(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 2))))


def read_tags(path: Path, dictionary: str = TAG_DICTIONARY) -> Tags:
    """Tags of a body from tags.csv. PointsFileError or VisionError names file, line and column."""
    table = read_table(path, TAGS, VisionError)
    number, size_m = table.number("tag").astype(int).tolist(), table.number("size_m").tolist()
    centre_m, turns = table.numbers(*TIP), table.quaternions(*ORIENTATION)
    is_turned = np.isfinite(turns).all(axis=1)
    turns[~is_turned] = (1.0, 0.0, 0.0, 0.0)
    corners_m: dict[int, Array] = {}
    for row, turn in enumerate(matrices(turns)):
        if number[row] in corners_m:
            raise VisionError(f"{table.place(row)}: tag {number[row]} appears twice")
        tag = _checked_number(number[row], dictionary, table.place(row))
        corners_m[tag] = frozen(_square(size_m[row]) @ turn.T + centre_m[row])
    return Tags(corners_m, dictionary)


def _square(size_m: float) -> Array:
    """Corners (4, 3) of a tag around its centre: upper left, upper right, lower right, lower left; y down."""
    return frozen(0.5 * size_m * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]))


def _checked_number(number: int, dictionary: str, where: str) -> int:
    words = _dictionary(dictionary).bytesList.shape[0]
    if not 0 <= number < words:
        raise VisionError(f"{where}: dictionary {dictionary} has tags 0 to {words - 1}, got {number}")
    return number


def _dictionary(name: str) -> Any:
    """OpenCV's dictionary by a name such as 4x4_250 or apriltag_36h11."""
    aruco = opencv().aruco
    known = {one[5:].lower(): getattr(aruco, one) for one in dir(aruco) if one.startswith("DICT_")}
    if name.lower() not in known:
        raise VisionError(f'--dictionary: expected one of {", ".join(sorted(known))}; got "{name}"')
    return aruco.getPredefinedDictionary(known[name.lower()])


def _refined(cv2: Any, method: str = "SUBPIX") -> Any:
    """Detector parameters with corners refined below a pixel, by one of OpenCV's methods."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = getattr(cv2.aruco, f"CORNER_REFINE_{method}")
    return parameters


# Corners of a dark square below a pixel: a line along each side, where the grey level changes most, and where they meet.
#
# Corner detectors pull the corner of a square inwards or outwards by some tenths of a pixel, all four alike: the square then
# looks too far or too near. Lines along the sides have no such error.
ENDS = 0.12  # of a side next to each corner, where the other side disturbs
MODULE = 1.0 / 8.0  # of a side: width of a tag's dark border, which the search must not leave
REACH_px = 5.0
STEP_px = 0.25
ROUNDS = 3
LEAST_SIDE_px = 16.0  # below it, a border of two pixels has no inside


def refined_square(picture: Picture, corners_px: Array) -> Array:
    """Corners (4, 2) refined; unchanged where the square is too small or a side has no edge."""
    refined_px = np.array(corners_px)
    for _ in range(ROUNDS):
        sides = [_line(picture, refined_px[k], refined_px[(k + 1) % 4]) for k in range(4)]
        lines = [side for side in sides if side is not None]
        if len(lines) < 4:
            return corners_px
        met = np.cross(np.array([lines[k - 1] for k in range(4)]), np.array(lines))
        refined_px = met[:, :2] / met[:, 2:]
    moved = np.abs(refined_px - corners_px).max()
    return refined_px if np.isfinite(moved) and moved < REACH_px else corners_px


def _line(picture: Picture, start: Array, end: Array) -> Array | None:
    """The line (3,) n . (u, v) + c = 0 along the edge between two corners."""
    along = end - start
    length = float(np.linalg.norm(along))
    if length < LEAST_SIDE_px:
        return None
    along = along / length
    outward = np.array([along[1], -along[0]])  # corners go clockwise in a picture whose y points down
    reach = min(REACH_px, 0.8 * MODULE * length)
    places = start + np.linspace(ENDS, 1.0 - ENDS, max(8, int(length)))[:, None] * (end - start)
    offsets = np.arange(-reach, reach + STEP_px, STEP_px)
    grey = _bilinear(picture, places[:, None] + offsets[:, None] * outward)
    slope = np.clip(np.diff(grey, axis=1), 0.0, None)  # from dark to light, going outwards
    weight = slope**2  # noise on both sides counts less than the edge
    strength = weight.sum(axis=1)
    is_edge = strength > 0.1 * np.median(strength)
    if is_edge.sum() < 5 or float(np.median(strength)) <= 0.0:
        return None
    middle = 0.5 * (offsets[1:] + offsets[:-1])
    at = (weight @ middle)[is_edge] / strength[is_edge]
    return _fitted(places[is_edge] + at[:, None] * outward)


def _fitted(points: Array) -> Array:
    """The line nearest to points (k, 2), twice, the second time without those far from it."""
    for _ in range(2):
        centre = points.mean(axis=0)
        normal = np.linalg.svd(points - centre, full_matrices=False)[2][1]
        off = np.abs((points - centre) @ normal)
        points = points[off <= 3.0 * max(float(np.median(off)), 1e-3)]
    return np.array([*normal, -normal @ centre])


def _bilinear(picture: Picture, places: Array) -> Array:
    """Grey levels at places (..., 2) as (u, v); beyond the rim those of the rim."""
    height, width = picture.shape
    u, v = np.clip(places[..., 0], 0, width - 1.001), np.clip(places[..., 1], 0, height - 1.001)
    j, i = u.astype(np.intp), v.astype(np.intp)
    right, down = u - j, v - i
    g = picture.astype(np.float64)
    upper = g[i, j] * (1 - right) + g[i, j + 1] * right
    return np.asarray(upper * (1 - down) + (g[i + 1, j] * (1 - right) + g[i + 1, j + 1] * right) * down)


DOTS_A_METRE = 12_000  # an edge is within 0.04 mm
MARGIN_m = 0.01
INCH_m = 0.0254


def write_print(path: Path, target: Charuco | Tags) -> Path:
    """Write the page; it is as large as the target with a white margin of 10 mm."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.figure import Figure

    picture = target.drawn(DOTS_A_METRE, MARGIN_m)
    height, width = picture.shape
    figure = Figure(figsize=(width / DOTS_A_METRE / INCH_m, height / DOTS_A_METRE / INCH_m))
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto")
    content = io.BytesIO()
    figure.savefig(content, format="pdf", dpi=DOTS_A_METRE * INCH_m)
    replace_file(path, content.getvalue())
    return path


TRIED = 10  # pictures that are looked at again
AROUND_px = 8  # of a corner: the part of the picture in which sharpness is judged


@dataclass(frozen=True, slots=True)
class Sighting:
    """The target in one picture. blur_px: standard deviation of the blur; contrast: ink to paper, in grey levels of 255."""

    name: str
    corners: SeenCorners
    blur_px: float
    contrast: float


@dataclass(frozen=True, slots=True)
class Sightings:
    """Pictures of one camera: those with the target, and the names of those without enough of it.

    remedy: the option with which pictures show the target that show none of it as it was given; "" if there is no such option.
    """

    width_px: int
    height_px: int
    seen: tuple[Sighting, ...]
    unseen: tuple[str, ...]
    remedy: str = ""


def look_for(target: PrintedTarget, files: Sequence[Path], least: int, advance: Advance = silent) -> Sightings:
    """Find a target in pictures of one camera; fewer than `least` corners do not count.

    VisionError for an unreadable picture, pictures of several sizes, or two with one name.
    """
    seen, unseen, size, first = [], [], (0, 0), files[0]
    names = [file.stem for file in files]
    for name in names:
        if names.count(name) > 1:
            raise VisionError(f"{first.parent}: two pictures are called {name}, with other endings: keep one")
    for k, file in enumerate(files):
        advance(f"looking at {file.name}", k / len(files))
        picture = read_picture(file)
        if k == 0:
            size = picture.shape
        if picture.shape != size:
            raise VisionError(
                f"{file}: {picture.shape[1]} x {picture.shape[0]} pixels, {first.name} has {size[1]} x {size[0]}: give"
                " pictures of one camera with one resolution, not turned"
            )
        corners = target.find(picture)
        if len(corners) < least or not _spans(corners):
            unseen.append(file.stem)
        else:
            seen.append(Sighting(file.stem, corners, *sharpness(picture, corners.picture_px)))
    advance("looking at pictures", 1.0)
    remedy = "" if seen else _remedy(target, files, least)
    return Sightings(size[1], size[0], tuple(seen), tuple(unseen), remedy)


def _remedy(target: PrintedTarget, files: Sequence[Path], least: int) -> str:
    """With which option most pictures, of some that are spread evenly, show the target."""
    tried = files[:: max(1, len(files) // TRIED)]
    shown = {
        option: sum(len(other.find(read_picture(file))) >= least for file in tried) for option, other in target.others.items()
    }
    best = max(shown, key=lambda option: shown[option], default="")
    return f"{best}, {shown[best]} of {len(tried)} pictures show it" if best and shown[best] else ""


def sharpness(picture: Picture, pixels: Array) -> tuple[float, float]:
    """Blur and contrast at corners (k, 2), median over them.

    A step of height C blurred by a normal distribution of standard deviation s has the largest slope C / (s sqrt(2 pi)).
    """
    blurs, contrasts = [], []
    for u, v in np.rint(pixels).astype(int).tolist():
        patch = picture[max(0, v - AROUND_px) : v + AROUND_px + 1, max(0, u - AROUND_px) : u + AROUND_px + 1]
        if min(patch.shape) <= AROUND_px:
            continue
        dark, light = np.percentile(patch, (5, 95))
        down, right = np.gradient(patch.astype(float))
        steepest = float(np.percentile(np.hypot(down, right), 98))
        contrasts.append(float(light - dark))
        blurs.append(contrasts[-1] / (max(steepest, 1e-3) * math.sqrt(2.0 * math.pi)))
    return (float(np.median(blurs)), float(np.median(contrasts))) if blurs else (math.nan, math.nan)


def _spans(corners: SeenCorners) -> bool:
    """Whether the corners are not all on one line."""
    centred = corners.target_m - corners.target_m.mean(axis=0)
    singular = np.linalg.svd(centred, compute_uv=False)
    return bool(singular[1] > 0.1 * singular[0])
