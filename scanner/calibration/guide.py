"""What a person who holds the target is told: whether a pose is new, what it adds, what the next one should be.

Pure: it knows the poses so far and says words. Pictures come from `sight`, figures from `solve`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.calibration.sight import SIDES, Sight, Standing, matrix_of_poses, standing_of
from scanner.calibration.targets import Target

Array = NDArray[np.float64]

GOOD_POSES = 12
MOST_POSES = 20
TILTED_DEG = 12.0
"""From here a pose counts as tilted to its side: what is nearer by 10 degrees does not yet tell focal from distance"""
WANTED_TILT = "by 20 to 30 degrees"
DEPTH_SHARE = 0.075
"""To be nearer and farther than the first pose, of its depth: 15 % in all, as the how-to asks"""
DEPTH_MARGIN = 0.025
"""What a hand is asked for beyond that"""
NEW_SHARE = 0.02
"""Of the picture's width by which points must differ on average from every earlier pose's: twice what the solve takes
for one pose. A tilt alone, about the target's middle, moves them by no more than two or three per cent."""
STILL_S = 1.0
STILL_SHARE = 0.0005
"""Of the picture's width by which a target's points may move on average in that time, 0.7 px of 1400: detection alone
is good to a tenth of that, a hand is not"""

FIELDS = (
    *("upper left", "upper edge", "upper right"),
    *("left edge", "middle", "right edge"),
    *("lower left", "lower edge", "lower right"),
)
"""Names of the picture's nine fields, row by row"""
OUTER = 0.25
"""Of the picture's width and height: the outer fields, which a pose must reach into"""
_CORNERS_FIRST = (0, 8, 2, 6, 1, 7, 3, 5, 4)


@dataclass(frozen=True, eq=False)
class Seen:
    """The points of one pose: ids (N,), points (N, 2) camera px."""

    name: str
    ids: NDArray[np.int64]
    points: Array


@dataclass(frozen=True, eq=False)
class Guide:
    """The poses so far. size: (width, height) px of the camera's picture; matrix: (3, 3), None until
    it is solved."""

    target: Target
    size: tuple[int, int]
    poses: tuple[Seen, ...] = ()
    matrix: Array | None = None

    @property
    def lens(self) -> Array:
        """The camera as far as it is known."""
        if self.matrix is not None:
            return self.matrix
        return matrix_of_poses(self.target, [(pose.ids, pose.points) for pose in self.poses], self.size)

    @property
    def standings(self) -> list[Standing]:
        """How each pose stands."""
        lens = self.lens
        return [standing_of(self.target, pose.ids, pose.points, lens) for pose in self.poses]

    def with_pose(self, pose: Seen) -> Guide:
        """One pose more."""
        return replace(self, poses=(*self.poses, pose))

    def undone(self) -> Guide:
        """Without the last pose."""
        return replace(self, poses=self.poses[:-1])

    def fields(self) -> NDArray[np.bool_]:
        """(9,) which fields of the picture hold points of a pose, row by row."""
        return self._fields(self.poses)

    def is_new(self, sight: Sight) -> bool:
        """Whether it differs from every earlier pose."""
        return all(moved(sight, pose) > NEW_SHARE * self.size[0] for pose in self.poses)

    def gain(self) -> str:
        """What the last pose adds, in words."""
        standings = self.standings
        last = standings[-1]
        about = "about " if self.matrix is None else ""  # the lens is guessed
        words = [f"tilt {about}{last.tilt_deg:.0f} degrees"]
        if last.tilt_deg >= TILTED_DEG:
            first = not any(_tilted_to(s, last.nearer) for s in standings[:-1])
            words[0] += f", its {last.nearer} {'side ' if last.nearer in SIDES[:2] else ''}nearer"
            words[0] += " for the first time" if first and len(standings) > 1 else ""
        before = self._fields(self.poses[:-1])
        new = [FIELDS[k] for k in _CORNERS_FIRST if self.fields()[k] and not before[k]]
        if new and before.any():
            words.append(f"new in the picture: {', '.join(new)}")
        words.append(f"{int(self.fields().sum())} of 9 fields of the picture")
        if len(standings) > 1:
            words.append(f"depth {last.depth / standings[0].depth - 1:+.0%} of the first pose's")
        return "; ".join(words)

    def advice(self) -> str:
        """What the next pose should be: tilts, depths and places that are lacking, in turn."""
        if not self.poses:
            return "hold the target in the middle of both pictures, facing the camera or a little tilted"
        wanted = (self._tilts_wanted(), self._depth_wanted(), self._place_wanted())
        turn = (len(self.poses) - 1) % 3
        for found in (*wanted[turn:], *wanted[:turn]):
            if found is not None:
                return found
        if len(self.poses) < GOOD_POSES:
            return f"all is covered, more of it makes it sure: {self._least()}"
        return "enough for a calibration: q ends, or go on with other tilts and places"

    def lacking(self) -> str:
        """Which conditions of the how-to the poses do not meet (tilts, depth, coverage), in words; "" if none."""
        if not self.poses:
            return ""
        standings = self.standings
        depths = np.array([s.depth for s in standings])
        span = float(np.ptp(depths) / depths[0])
        words = []
        if untilted := [side for side in SIDES if not any(_tilted_to(s, side) for s in standings)]:
            words.append(f"no pose is tilted with its {' or its '.join(untilted)} nearer")
        if span < 2 * DEPTH_SHARE:
            words.append(
                f"depths of the target's middle span {span:.1%} of the first pose's ({2 * DEPTH_SHARE:.0%} are asked)"
            )
        if missing := [name for name, there in zip(FIELDS, self.fields(), strict=True) if not there]:
            words.append(f"no points in {len(missing)} of 9 fields of the camera's picture ({', '.join(missing)})")
        return "; ".join(words)

    def _tilts_wanted(self) -> str | None:
        standings = self.standings
        counts = {side: sum(_tilted_to(s, side) for s in standings) for side in SIDES}
        fewest = min(counts.values())
        if fewest >= 1 + (len(self.poses) >= GOOD_POSES // 2):
            return None
        again = " once more, elsewhere in the picture" if fewest else ""
        opposite = dict(zip(SIDES, ("right", "left", "bottom", "top"), strict=True))
        last = standings[-1]
        other = opposite[last.nearer]
        if last.tilt_deg >= TILTED_DEG and counts[other] == fewest:
            return f"tilt it the other way{again}: its {other} towards the camera, {WANTED_TILT}"
        side = next(side for side in SIDES if counts[side] == fewest)
        return f"tilt it{again}: its {side} towards the camera, {WANTED_TILT}"

    def _depth_wanted(self) -> str | None:
        depths = np.array([s.depth for s in self.standings])
        share = depths / depths[0] - 1
        nearest, farthest, now = float(share.min()), float(share.max()), float(share[-1])
        if farthest - nearest >= 2 * DEPTH_SHARE:
            return None
        # As far to both sides of the first pose; where one side has been reached, the whole range from the other.
        near = farthest - 2 * DEPTH_SHARE if nearest <= -DEPTH_SHARE else max(-DEPTH_SHARE, farthest - 2 * DEPTH_SHARE)
        far = nearest + 2 * DEPTH_SHARE if farthest >= DEPTH_SHARE else min(DEPTH_SHARE, nearest + 2 * DEPTH_SHARE)
        nearer, farther = now - near, far - now
        if nearer <= farther:
            return f"bring it nearer by {max(nearer + DEPTH_MARGIN, 0.05):.0%}"
        return f"take it farther by {max(farther + DEPTH_MARGIN, 0.05):.0%}"

    def _place_wanted(self) -> str | None:
        covered = self.fields()
        missing = [k for k in _CORNERS_FIRST if not covered[k]]
        if not missing:
            return None
        return f"move it to the {FIELDS[missing[0]]} of the picture"

    def _least(self) -> str:
        """The side and the field that the fewest poses have."""
        standings = self.standings
        side = min(SIDES, key=lambda side: sum(_tilted_to(s, side) for s in standings))
        each = np.sum([self._fields((pose,)) for pose in self.poses], axis=0)
        field = min(_CORNERS_FIRST, key=lambda k: int(each[k]))
        return f"at the {FIELDS[field]} of the picture, its {side} towards the camera"

    def _fields(self, poses: tuple[Seen, ...]) -> NDArray[np.bool_]:
        return fields_of(np.concatenate([np.empty((0, 2)), *(pose.points for pose in poses)]), self.size)


class Stillness:
    """Tells when a target has stood still for STILL_S. Times are handed in, s."""

    def __init__(self, width: int) -> None:
        self._most = STILL_SHARE * width
        self._seen: deque[tuple[float, Sight]] = deque(maxlen=100)

    def forget(self) -> None:
        """Begin anew: the target was lost, or captured."""
        self._seen.clear()

    def see(self, t_s: float, sight: Sight) -> bool:
        """Take a look in; whether the target has stood still until now."""
        if any(moved(sight, earlier) > self._most for _, earlier in self._seen):
            self._seen.clear()
        self._seen.append((t_s, sight))
        while len(self._seen) > 1 and t_s - self._seen[1][0] >= STILL_S:
            self._seen.popleft()
        return t_s - self._seen[0][0] >= STILL_S


def fields_of(points: Array, size: tuple[int, int]) -> NDArray[np.bool_]:
    """(9,) which fields of a picture hold any of these points, (N, 2) px, row by row."""
    covered = np.zeros(9, dtype=bool)
    share = (points + 0.5) / size
    at = (share > OUTER).astype(int) + (share > 1 - OUTER)
    covered[3 * at[:, 1] + at[:, 0]] = True
    return covered


def moved(here: Sight | Seen, there: Sight | Seen) -> float:
    """Mean distance in px of the points that both have; infinite where they share none."""
    _, a, b = np.intersect1d(here.ids, there.ids, return_indices=True)
    return float(np.linalg.norm(here.points[a] - there.points[b], axis=1).mean()) if len(a) else float("inf")


def status(sight: Sight | str, guide: Guide) -> str:
    """The one line at the terminal: seen or not, and why; how it stands."""
    if isinstance(sight, str):
        return f"target not seen: {sight}"
    how = f"tilt {sight.standing.tilt_deg:.0f} deg"
    if guide.poses:
        how += f", depth {sight.standing.depth / guide.standings[0].depth - 1:+.0%}"
    if sight.trouble is not None:
        return f"target seen, but {sight.trouble} ({how})"
    return f"target seen: {len(sight.ids)} points, {how}" + ("" if guide.is_new(sight) else "; as an earlier pose")


def _tilted_to(standing: Standing, side: str) -> bool:
    return standing.tilt_deg >= TILTED_DEG and standing.nearer == side
