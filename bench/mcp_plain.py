"""Stages of the default MCP decoder in plain NumPy, beside its kernels: the same arguments, results compared, times.

Arguments are those of a real frame, recorded while it is decoded. What has a plain form here: columns by fours, the
emissions' likelihoods, the model of the columns (forward-backward and Viterbi over all columns at once), and XYZ of
rows. What has none: peaks, chains along stripes, amplitudes, votes, sub-pixel fit, dense rows. Those go from peak to
peak or from piece to piece, which arrays at once do not; the tests have them written out element by element.
"""

from __future__ import annotations

import time

import numpy as np

from scanner.decode.mcp import emissions, hmm, stripes
from scanner.triangulation import triangulate

RUNS = 5


def compare(decode, image, calibration, rows):
    """Print the time of each stage in both forms, and their ratio.

    Args:
        decode: decodes the frame once.
        image: (H, W), stripes horizontal.
        calibration: without distortion.
        rows: (H, W) float32 of the frame.
    """
    stages = [
        ("columns by fours", stripes.reduce_columns, columns_by_fours, (image,), 1e-3, 1.0),
        (
            "likelihoods",
            emissions.log_likelihood,
            likelihoods,
            recorded(decode, emissions, "log_likelihood"),
            1e-2,
            1.0,
        ),
        # Kernels pass over shares below a millionth; the best of paths all but alike may be another.
        ("columns' model", hmm.smooth_columns, smooth, recorded(decode, hmm, "smooth_columns"), 1e-2, 0.999),
        ("best paths", hmm.best_paths, best_paths, recorded(decode, hmm, "best_paths"), 0, 0.999),
        ("XYZ", lambda *a: triangulate(a[0], rows=a[1]).xyz, points, (calibration, rows), 1e-2, 1.0),
    ]
    print("  beside plain NumPy, the same run (one thread, ms of CPU):")
    spent = np.zeros(2)
    for name, kernel, plain, arguments, apart, alike in stages:
        ours, found = least(kernel, arguments)
        theirs, expected = least(plain, arguments)
        for a, b in zip(as_tuple(found), as_tuple(expected), strict=True):
            share = np.isclose(a, b, rtol=0, atol=apart, equal_nan=True).mean()
            assert share >= alike, f"{name}: the forms agree on {share:.4%} of the values only"
        spent += ours, theirs
        print(f"    {name:18s}{ours:7.2f}{theirs:9.1f}   {theirs / ours:6.1f} x")
    print(f"    {'these together':18s}{spent[0]:7.2f}{spent[1]:9.1f}   {spent[1] / spent[0]:6.1f} x")
    print("    no plain form in arrays: peaks, chains, amplitudes, votes, sub-pixel fit, dense rows")


def as_tuple(found):
    return found if isinstance(found, tuple) else (found,)


def least(work, arguments):
    """Least CPU time, ms, and the result."""
    times = []
    for _ in range(RUNS):
        begin = time.thread_time()
        result = work(*arguments)
        times.append(1e3 * (time.thread_time() - begin))
    return min(times), result


def recorded(decode, module, name):
    """The arguments of the last call of `module.name` while a frame is decoded."""
    function, calls = getattr(module, name), []

    def record(*arguments):
        calls.append(arguments)
        return function(*arguments)

    setattr(module, name, record)
    try:
        decode()
    finally:
        setattr(module, name, function)
    return calls[-1]


def columns_by_fours(image):
    height, width = image.shape
    return image[:, : width // 4 * 4].reshape(height, -1, 4).mean(axis=2, dtype=np.float32).T


def likelihoods(seen, model, modulation, floor):
    """Rayleigh where a carrier is off, a Gaussian about what Rice expects where it is on, a flat share in both."""
    sigma = np.hypot(seen.sigma, floor)
    flat = 1 / (np.maximum(1.5 * model.ratio.max(axis=0), 1e-3) + 2.5 * sigma)
    z = seen.ratio / sigma
    off = np.maximum(z, 0.02) / sigma * np.exp(-0.5 * z**2)
    result = np.zeros((len(sigma), model.stripes), np.float32)
    for s in range(model.stripes):
        mean = model.ratio[s] * modulation
        wide = np.hypot(sigma, emissions.SPREAD * mean)
        on = 0.39894 / wide * np.exp(-0.5 * ((np.hypot(mean, sigma) - seen.ratio) / wide) ** 2)
        density = (1 - emissions.OUTLIER) * np.where(mean == 0, off, on) + emissions.OUTLIER * flat
        result[:, s] = np.log(density).sum(axis=1) + (np.log(1e-4) if model.level[s] == 0 else 0)
    return result, np.log(flat).sum(axis=1)


def columns_of(start):
    """(B, T) peak of each column and place, and whether there is one."""
    count = np.diff(start)
    place = np.arange(count.max())
    there = place < count[:, None]
    return np.where(there, start[:-1, None] + place, 0), there


def smooth(evidence, start, gap, tables, stray_log):
    """Forward and backward sums, all columns at once."""
    peak, there = columns_of(start)
    top = np.maximum(evidence.max(axis=1), stray_log)
    likely = (1 - hmm.STRAY) * np.exp(evidence - top[:, None])
    lost = hmm.STRAY * np.exp(stray_log - top)
    columns, places, states = *peak.shape, evidence.shape[1]
    alpha, moved = np.full((places + 1, columns, states), 1 / states), np.empty((places, columns, states))
    for t in range(places):
        p, here = peak[:, t], there[:, t, None]
        moved[t] = alpha[t] if t == 0 else np.einsum("bs,bsu->bu", alpha[t], tables[gap[p]])
        mixed = moved[t] * likely[p] + alpha[t] * lost[p, None]
        alpha[t + 1] = np.where(here, mixed / mixed.sum(axis=1, keepdims=True), alpha[t])
    beta = np.ones((columns, states))
    posterior, stray = np.zeros(evidence.shape), np.zeros(len(evidence))
    for t in range(places - 1, -1, -1):
        p, here = peak[:, t], there[:, t]
        product = likely[p] * beta
        good, bad = moved[t] * product, (alpha[t] * lost[p, None] * beta).sum(axis=1)
        total = good.sum(axis=1) + bad
        posterior[p[here]], stray[p[here]] = (good / total[:, None])[here], (bad / total)[here]
        back = np.einsum("bu,bsu->bs", product, tables[gap[p]]) + beta * lost[p, None]
        beta = np.where(here[:, None], back / back.sum(axis=1, keepdims=True), beta)
    return posterior, stray


def best_paths(evidence, start, gap, tables, stray_log):
    """Viterbi, all columns at once."""
    peak, there = columns_of(start)
    logs, states = np.log(tables), evidence.shape[1]
    score = np.zeros((len(peak), states))
    came, real = [], []
    for t in range(peak.shape[1]):
        p, here = peak[:, t], there[:, t, None]
        if t == 0:
            best, source = score, np.broadcast_to(np.arange(states), score.shape)
        else:
            ways = score[:, :, None] + logs[gap[p]]
            best, source = ways.max(axis=1), ways.argmax(axis=1)
        taken = best + np.log(1 - hmm.STRAY) + evidence[p]
        passed = score + np.log(hmm.STRAY) + stray_log[p, None]
        real.append((taken >= passed) & here)
        came.append(np.where(real[-1], source, np.arange(states)))
        score = np.where(here, np.maximum(taken, passed), score)
    path = np.full(len(evidence), -1, np.int32)
    state, all_columns = score.argmax(axis=1), np.arange(len(peak))
    for t in range(peak.shape[1] - 1, -1, -1):
        on = real[t][all_columns, state]
        path[peak[on, t]] = state[on]
        state = came[t][all_columns, state]
    return path


def points(calibration, rows):
    """Where the camera's ray meets the plane of the projector row (Casey 2011, sec. 3.5)."""
    width, height = calibration.camera.size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    c, p = calibration.camera.matrix, calibration.projector.matrix
    v = (y - c[1, 2]) / c[1, 1]
    ray = np.stack(((x - c[0, 2] - c[0, 1] * v) / c[0, 0], v, np.ones_like(v)), axis=-1)
    turned = ray @ calibration.rotation.T
    t = calibration.translation
    slope = (rows - p[1, 2]) / p[1, 1]
    z = (t[1] - slope * t[2]) / (slope * turned[..., 2] - turned[..., 1])
    return (ray * z[..., None]).astype(np.float32)
