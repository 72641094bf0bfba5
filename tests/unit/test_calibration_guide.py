"""The guide's words: how a target stands, whether a pose is new, what it adds and what comes next; without devices."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers.simulated.optics import Optics
from drivers.simulated.rigs import rig
from drivers.simulated.scenes import SceneOptions, build_scene
from drivers.simulated.targets import target_points, target_poses
from drivers.simulated.view import view_scene
from scanner.calibration.guide import FIELDS, GOOD_POSES, NEW_SHARE, STILL_S, Guide, Seen, Stillness, moved, status
from scanner.calibration.guide_picture import HEIGHT, WIDTH, guide_picture
from scanner.calibration.sight import Sight, edge_width, guessed_matrix, look, standing_of
from scanner.calibration.targets import parse_target
from tests.unit.calibration_bench import CAMERA_SIZE, TARGET, made_up_rig, view_of

RIG = made_up_rig()
MATRIX = RIG.camera.matrix
QUICK_TARGET = parse_target("chessboard:9x6:19")


def seen(turn: tuple[float, float] = (0.0, 0.0), at: tuple[float, float, float] = (0.0, 0.0, 700.0)) -> Seen:
    """A pose turned about x and y (radians; OpenCV's signs), as the camera sees it."""
    view = view_of(RIG, np.array([*turn, 0.0, *at]), "pose")
    return Seen("pose", view.ids, view.camera)


def sight(pose: Seen, trouble: str | None = None) -> Sight:
    return Sight(pose.ids, pose.points, standing_of(TARGET, pose.ids, pose.points, MATRIX), trouble)


def guide_of(*poses: Seen) -> Guide:
    return Guide(TARGET, CAMERA_SIZE, poses, MATRIX)


# --- how it stands ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("matrix", [MATRIX, guessed_matrix(CAMERA_SIZE)])
@pytest.mark.parametrize("turn", [(0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)])
def test_the_nearer_side_is_named_with_a_known_lens_and_with_a_guessed_one(
    turn: tuple[float, float], matrix: np.ndarray
) -> None:
    pose = seen(turn)
    in_camera = TARGET.points @ cv2.Rodrigues(np.array([*turn, 0.0]))[0].T
    nearest = TARGET.points[np.argmin(in_camera[:, 2])]
    sides = ("left", "right") if turn[1] else ("top", "bottom")
    expected = sides[int(nearest[0 if turn[1] else 1] > 0)]
    standing = standing_of(TARGET, pose.ids, pose.points, matrix)
    assert standing.nearer == expected
    assert standing.tilt_deg == pytest.approx(np.degrees(0.4), abs=3.0)


@pytest.mark.parametrize("share", [0.8, 1.5, 3.0])
@pytest.mark.parametrize("turn", [(0.35, 0.0), (0.0, -0.5), (0.25, 0.25)])
def test_one_tilted_pose_tells_the_focal_length_and_so_its_tilt(share: float, turn: tuple[float, float]) -> None:
    focal, middle = share * CAMERA_SIZE[0], np.array(CAMERA_SIZE) / 2 + (6, -4)
    rotation = cv2.Rodrigues(np.array([*turn, 0.1]))[0]
    in_camera = (TARGET.points - TARGET.points.mean(axis=0)) @ rotation.T + (20, 10, 600 * share)
    noise = np.random.default_rng(1).normal(0, 0.05, (len(in_camera), 2))
    points = focal * in_camera[:, :2] / in_camera[:, 2:] + middle + noise
    guide = Guide(TARGET, CAMERA_SIZE, (Seen("pose", np.arange(len(points)), points),))
    assert guide.lens[0, 0] == pytest.approx(focal, rel=0.06)
    assert guide.standings[0].tilt_deg == pytest.approx(np.degrees(np.arccos(rotation[2, 2])), abs=0.5)


def test_poses_that_face_the_camera_leave_the_focal_length_guessed() -> None:
    guide = Guide(TARGET, CAMERA_SIZE, (seen(), seen((0.1, 0.0))))
    np.testing.assert_array_equal(guide.lens, guessed_matrix(CAMERA_SIZE))


def test_depths_are_in_proportion_whatever_the_focal_length() -> None:
    guessed = guessed_matrix(CAMERA_SIZE)
    near, far = (standing_of(TARGET, p.ids, p.points, guessed) for p in (seen(), seen(at=(0, 0, 840))))
    assert far.depth / near.depth == pytest.approx(1.2, abs=0.01)


# --- what to do next -------------------------------------------------------------------------------------------------


def test_the_first_pose_is_asked_for_in_the_middle() -> None:
    assert "middle" in guide_of().advice()


def test_a_tilt_is_followed_by_its_opposite() -> None:
    tilted = guide_of(seen((0.0, 0.4)))
    nearer = tilted.standings[0].nearer
    other = {"left": "right", "right": "left"}[nearer]
    assert tilted.advice().startswith(f"tilt it the other way: its {other} towards")


def test_depth_and_place_are_asked_for_in_turn() -> None:
    two = guide_of(seen((0.0, 0.4)), seen((0.0, -0.4)))
    assert two.advice() == "bring it nearer by 10%"
    three = two.with_pose(seen((0.0, 0.1), (0.0, 0.0, 620.0)))
    place = three.advice()
    missing = [name for name, covered in zip(FIELDS, three.fields(), strict=True) if not covered]
    assert any(place == f"move it to the {name} of the picture" for name in missing)


@pytest.mark.parametrize(
    ("depths", "advice"),
    [
        ((700, 700), "bring it nearer by 10%"),
        ((700, 798), "take it farther by 5%"),
        ((700, 798, 700), "bring it nearer by 5%"),
        ((700, 640), "bring it nearer by 9%"),
        ((700, 612), "bring it nearer by 5%"),
        ((700, 590), None),
    ],
)
def test_depth_is_asked_for_by_the_shorter_way_and_only_as_far_as_it_lacks(
    depths: tuple[int, ...], advice: str | None
) -> None:
    poses = [seen((0.0, 0.05), (0.0, 0.0, float(z))) for z in depths]
    assert guide_of(*poses)._depth_wanted() == advice


def test_a_tilt_that_was_there_is_asked_for_once_more_elsewhere() -> None:
    tilts = ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4))
    guide = guide_of(*(seen(tilt) for tilt in (*tilts, (0.0, 0.0), (0.0, 0.0))))
    assert "once more, elsewhere" in str(guide._tilts_wanted())
    assert "once more" not in str(guide_of(seen(tilts[0]))._tilts_wanted())


def test_nothing_is_asked_for_that_there_is() -> None:
    """Poses that follow the advice make the guide content, and it says so only once there are enough."""
    everything = [
        seen((tilt_x, tilt_y), (x, y, z))
        for z in (600.0, 700.0, 800.0)
        for (tilt_x, tilt_y), (x, y) in zip(
            ((0.4, 0), (-0.4, 0), (0, 0.4), (0, -0.4)),
            ((-110, -80), (110, 80), (110, -80), (-110, 80)),
            strict=True,
        )
    ]
    whole = guide_of(*everything)
    assert len(everything) == GOOD_POSES
    assert whole.fields().all()
    assert whole.advice().startswith("enough for a calibration")
    assert whole.undone().advice().startswith("all is covered, more of it makes it sure: at the ")
    assert whole.undone().undone().advice() != whole.undone().advice()


def test_what_a_pose_adds_is_said() -> None:
    first = seen((0.0, 0.0), (-90.0, -60.0, 700.0))
    second = seen((0.4, 0.0), (90.0, 60.0, 770.0))
    words = guide_of(first, second).gain()
    assert "for the first time" in words
    assert "new in the picture: lower right" in words
    assert "depth +1" in words


# --- whether to capture ----------------------------------------------------------------------------------------------


def test_a_pose_is_new_when_it_differs_from_every_earlier_one() -> None:
    guide = guide_of(seen(), seen((0.4, 0.0)))
    assert not guide.is_new(sight(seen(at=(1.0, 0.0, 700.0))))
    assert guide.is_new(sight(seen(at=(60.0, 0.0, 700.0))))
    nothing = Sight(np.empty(0, np.int64), np.empty((0, 2)), sight(seen()).standing)
    assert moved(nothing, seen()) == np.inf


def test_still_means_for_a_second_without_a_step() -> None:
    still = Stillness(CAMERA_SIZE[0])
    here, there = sight(seen()), sight(seen(at=(5.0, 0.0, 700.0)))
    assert [still.see(t, here) for t in (0.0, 0.5, STILL_S)] == [False, False, True]
    assert [still.see(t, there) for t in (1.5, 2.0, 2.5)] == [False, False, True]
    still.forget()
    assert not still.see(3.0, there)
    # One that creeps never stands still, however small each step is.
    creeping = Stillness(CAMERA_SIZE[0])
    steps = [sight(seen(at=(0.2 * k, 0.0, 700.0))) for k in range(12)]
    assert not any(creeping.see(0.5 * k, step) for k, step in enumerate(steps))


def test_the_line_says_whether_it_is_seen_and_why_not() -> None:
    guide = guide_of(seen())
    assert status("the picture is black", guide) == "target not seen: the picture is black"
    assert status(sight(seen(), "too tilted"), guide).startswith("target seen, but too tilted")
    assert status(sight(seen()), guide).endswith("as an earlier pose")
    assert "depth +20%" in status(sight(seen(at=(0, 0, 840))), guide)


# --- pictures --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lit() -> np.ndarray:
    """A chessboard on the quick rig under white light, uint8."""
    chosen = rig("quick")
    view = view_scene(chosen, build_scene("chessboard_poses", SceneOptions(pose=3), chosen, 0), Optics())
    light = cv2.GaussianBlur(view.shade + view.floor, (0, 0), 0.7)  # of a lens
    return np.clip(light / light.max() * 230, 0, 255).astype(np.uint8)


def test_the_walk_of_the_guide_meets_what_is_asked_and_each_pose_is_new() -> None:
    """`calibrate run "simulated:charuco_poses?walk=true&seed=198"`: twelve poses, none of them captured in vain."""
    lens, board = rig("casey2011").calibration.camera, parse_target("charuco:10x7:30")
    points = target_points("charuco_poses", rig("casey2011"))
    guide = Guide(board, lens.size, matrix=lens.matrix)
    for pose in target_poses("charuco_poses", rig("casey2011"), 198):
        seen = Seen("", np.arange(len(points)), lens.project(points @ pose.rotation.T + pose.translation))
        assert all(moved(seen, earlier) > 2 * NEW_SHARE * lens.size[0] for earlier in guide.poses)
        guide = guide.with_pose(seen)
    assert len(guide.poses) == GOOD_POSES
    assert guide.lacking() == ""


def test_a_lit_target_is_seen_where_it_stands(lit: np.ndarray) -> None:
    lens = rig("quick").calibration.camera
    found = look(lit, QUICK_TARGET, lens.matrix)
    assert isinstance(found, Sight)
    assert found.trouble is None
    assert len(found.ids) == 54
    truth = target_poses("chessboard_poses", rig("quick"), 0)[3]
    assert found.standing.tilt_deg == pytest.approx(np.degrees(np.arccos(truth.rotation[2, 2])), abs=2.0)
    assert found.standing.depth == pytest.approx(truth.translation[2], rel=0.01)
    # Every second pixel shows it at the same place.
    doubled = cv2.resize(lit, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    halved = look(np.ascontiguousarray(doubled[::2, ::2]), QUICK_TARGET, lens.matrix, stride=2)
    assert isinstance(halved, Sight)
    assert np.abs(halved.points - (2 * found.points + 0.5)).max() < 0.01


def test_what_stands_in_the_way_is_named(lit: np.ndarray) -> None:
    matrix = rig("quick").calibration.camera.matrix
    assert "dark" in str(look(lit // 30, QUICK_TARGET, matrix))
    assert "too bright" in str(look(np.full_like(lit, 255), QUICK_TARGET, matrix))
    blurred = cv2.GaussianBlur(cv2.resize(lit, None, fx=3, fy=3), (0, 0), 8)
    assert "blurred" in _trouble(look(blurred, QUICK_TARGET, matrix))
    found = look(lit, QUICK_TARGET, matrix)
    assert isinstance(found, Sight)
    half = lit.copy()
    half[:, : int(found.points[:, 0].min()) + 80] //= 6
    assert "not lit" in _trouble(look(half, QUICK_TARGET, matrix))
    tilted = sight(seen((0.0, 0.9)))
    assert tilted.standing.tilt_deg > 45


def _trouble(found: Sight | str) -> str:
    return found if isinstance(found, str) else str(found.trouble)


@pytest.mark.parametrize("sigma", [1.5, 3.0])
def test_the_width_of_edges_is_measured(sigma: float) -> None:
    step = np.zeros((100, 200), np.float32)
    step[:, 100:] = 200
    assert edge_width(cv2.GaussianBlur(step, (0, 0), sigma)) == pytest.approx(sigma, rel=0.15)


def test_the_picture_shows_target_and_coverage(lit: np.ndarray) -> None:
    found = look(lit, QUICK_TARGET, guessed_matrix((320, 240)))
    assert isinstance(found, Sight)
    none, empty = (
        guide_picture(lit, what, Guide(QUICK_TARGET, (320, 240)), "line", "next") for what in ("not seen", found)
    )
    assert none.shape == empty.shape == (HEIGHT, WIDTH, 3)
    assert (none != empty).any(axis=2).sum() > 500
    one = Guide(QUICK_TARGET, (320, 240), (Seen("01", found.ids, found.points),))
    covered = guide_picture(lit, found, one, "line", "next")
    assert (covered != empty)[:, WIDTH - 316 :].any(axis=2).sum() > 500
