"""Waveforms: what a receiver gets of a pulse over time, and the returns that are found in it.

Pulse and receiver are Gaussian. So a waveform is a sum of Gaussians, one for each hit of a sub-ray,
as wide as the pulse appears to the receiver: the system waveform (Wagner et al. 2006). Its height
is in units of energy: an echo that nothing has stretched is as high as its energy.

The same hits give the same bits in any batch: sums go by `bincount`, which adds in order, and
equations are solved by operations on one number of each pulse at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Ints, Records
from ..base.elementary import exp, log
from ..columns.waveforms import SILENT, ZERO, record
from ..sensor.noise import Purpose, normal, raw
from ..sensor.optics import FWHM, LIGHT_M_NS, WINDOW_SIGMAS
from .hits import Hits, Keys, Planes, numbers, runs, strongest
from .separation import continued

# All in standard deviations of the system waveform.
CUT = WINDOW_SIGMAS / 2  # beyond that an echo is 0; it is 4e-6 of its height there
# Hits within this are one echo in closed form: position and height err by 1e-3 at most.
NARROW = 0.25
MEET = 1.0  # planes of neighbouring hits that meet as closely are one surface, see `continued`
APART = 6.0  # Gaussians that are farther apart are fitted separately
CLOSE = 1.0  # Gaussians that are nearer are one return

FAINT = 0.01  # of the strongest echo around: weaker ones are not found
CURVED = 0.005  # of the greatest curvature of that, likewise for Gaussians
TOGETHER = 4  # Gaussians that are fitted together at most
STEPS = 10  # of Levenberg and Marquardt at most
GAIN, ENOUGH = 1e-3, 1e-9  # share of the squares that a step must gain, and squares that are none
MOVES = 2.0  # standard deviations that a fit may move from its first guess
HIGHEST = 1.2  # of the highest sample: a Gaussian between two samples may be higher
BLOCK_HITS = 1 << 15  # whose waveforms are made at a time
BLOCK_SAMPLES = 1 << 20  # of recorded waveforms that are made at a time


@dataclass(frozen=True)
class Digitizer:
    """Standard deviation of the system waveform and the time between samples, ns."""

    sigma_ns: float
    sample_ns: float
    decomposes: bool  # into Gaussians; else it finds peaks

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the system waveform in range."""
        return self.sigma_ns * LIGHT_M_NS / 2

    @property
    def sigma(self) -> float:
        """Standard deviation of the system waveform, samples."""
        return self.sigma_ns / self.sample_ns

    @property
    def reach(self) -> int:
        """Samples before and behind an echo that it reaches."""
        return int(np.ceil(CUT * self.sigma))

    def samples(self, distance: Floats) -> Floats:
        """Return when light comes back, samples after the pulse."""
        return distance * (2 / LIGHT_M_NS / self.sample_ns)

    def amplitude(self, energy: Floats, width: Floats) -> Floats:
        """Heights of echoes (n,) by energy and full width at half maximum, ns; 0 is unknown."""
        system_ns = FWHM * self.sigma_ns
        return np.asarray(energy * (system_ns / np.where(width > 0, width, system_ns)))


@dataclass(frozen=True)
class _Found:
    """Echoes in waveforms, in order: arrays (m,)."""

    position: Floats  # samples after the pulse
    energy: Floats
    width: Floats  # of the system waveform's


def returns_in(
    hits: Hits, digitizer: Digitizer, each: int = 1, planes: Planes | None = None
) -> Hits:
    """Make returns of the waveforms of beams; arguments and order as of `separated`.

    Hits that lie close together, or on one surface (see `continued`), are one Gaussian with their
    mean and variance. Other waveforms are sampled and searched. The triangle and colour of a return
    are those of its strongest hit.
    """
    rows = np.arange(len(hits.ray))
    some = hits.energy > 0
    if not some.all():
        rows, hits = rows[some], hits.take(some)
    if not len(rows):
        return hits._replace(width=np.zeros(0))
    beam = hits.ray // each
    begins, counts = runs(beam)
    extent = np.maximum.reduceat(hits.distance, begins) - np.minimum.reduceat(hits.distance, begins)
    new = np.zeros(len(rows), np.bool_)
    new[begins] = True
    echo = np.full(len(rows), -1)  # of each hit, where its waveform was searched
    found = _Found(*np.zeros((3, 0)))
    narrow = NARROW * digitizer.sigma_m
    wide = np.flatnonzero(np.repeat(extent > narrow, counts))
    if len(wide):
        order = np.arange(len(rows))
        order[wide] = wide[np.lexsort((hits.distance[wide], beam[wide]))]
        rows, hits = rows[order], hits.take(order)
        new[1:] |= np.diff(hits.distance) > 2 * CUT * digitizer.sigma_m
        # Of those beams, what is together and yet not narrow.
        begins, counts = runs(np.cumsum(new, dtype=np.int64)[wide])
        ends = wide[begins + counts - 1]
        broad = hits.distance[ends] - hits.distance[wide[begins]] > narrow
        gap_m = MEET * digitizer.sigma_m
        if planes is not None and each > 1 and broad.any():
            on = wide[np.repeat(broad, counts)]
            every = np.ones(len(on), np.bool_)
            inside = continued(
                hits.take(on), every, gap_m, each, *(one[rows[on]] for one in planes)
            )
            starts = np.cumsum(counts[broad]) - counts[broad]
            inside[starts] = True
            broad[broad] = ~np.logical_and.reduceat(inside, starts)
        on = wide[np.repeat(broad, counts)]
        if len(on):
            share, together = hits.energy[on] / each, counts[broad]
            echo[on], found = _searched(hits.distance[on], share, together, digitizer)
            new[on] |= np.diff(echo[on], prepend=-1) != 0
        if planes is not None and each > 1:
            begins, counts = runs(beam[wide])
            several = np.add.reduceat(new[wide], begins, dtype=np.int64) > 1
            falls = wide[np.repeat(several, counts)]
            if len(falls):
                part, marks = hits.take(falls), new[falls]
                new[falls] &= ~continued(
                    part, marks, gap_m, each, *(one[rows[falls]] for one in planes)
                )
    begins = np.flatnonzero(new)
    which = np.cumsum(new) - 1
    energy = np.bincount(which, hits.energy).astype(np.float64)
    distance = np.bincount(which, hits.energy * hits.distance) / energy
    off = (hits.distance - distance[which]) / digitizer.sigma_m
    width = np.sqrt(1 + np.bincount(which, hits.energy * off**2) / energy)
    energy /= each
    # What was found in a waveform, if no surface joins it with anything else.
    last = np.append(begins[1:], len(rows)) - 1
    alone = np.flatnonzero((echo[begins] >= 0) & (echo[begins] == echo[last]))
    what = echo[begins[alone]]
    distance[alone] = found.position[what] * (digitizer.sample_ns * LIGHT_M_NS / 2)
    energy[alone], width[alone] = found.energy[what], found.width[what]
    first = hits.take(strongest(hits.energy, begins, np.diff(begins, append=len(rows))))
    width *= FWHM * digitizer.sigma_ns
    velocity = None
    if hits.velocity is not None:
        velocity = np.bincount(which, hits.energy * hits.velocity) / np.bincount(which, hits.energy)
    own = {"ray": beam[begins], "distance": distance, "energy": energy, "width": width}
    return first._replace(**own, velocity=velocity)


def _searched(
    distance: Floats, energy: Floats, counts: Ints, digitizer: Digitizer
) -> tuple[Ints, _Found]:
    """Find the echoes of pulses, and which of them each hit belongs to, or -1.

    Hits are in the order of pulses, so many of each, and distances.
    """
    ends = np.cumsum(counts)
    echoes, found = [], []
    begin = done = before = 0
    while done < len(counts):
        stop = max(done + 1, int(np.searchsorted(ends, begin + BLOCK_HITS, side="right")))
        part, end = slice(begin, ends[stop - 1]), int(ends[stop - 1])
        echo, some = _of_block(distance[part], energy[part], counts[done:stop], digitizer)
        echoes.append(np.where(echo < 0, -1, echo + before))
        found.append(some)
        before, begin, done = before + len(some.position), end, stop
    columns = ([getattr(one, name) for one in found] for name in ("position", "energy", "width"))
    return np.concatenate(echoes), _Found(*map(np.concatenate, columns))


@dataclass(frozen=True)
class _Waves:
    """Samples of some waveforms one after the other, each with a 0 before and behind.

    Places are whole numbers of samples; times are samples after the pulse, as real numbers, so that
    they have the same bits wherever their waveform stands.
    """

    samples: Floats
    begins: Ints  # (c,): place of the first sample of each
    lows: Ints  # (c,): its time
    tops: Floats  # (c,): highest samples

    def owner(self, place: Ints) -> Ints:
        """Waveforms of places."""
        return np.searchsorted(self.begins, place, side="right") - 1

    def shift(self, owner: Ints) -> Ints:
        """Places at time 0, as if waveforms began there."""
        return self.begins[owner] - self.lows[owner]


def _key(time: Floats, shift: Ints) -> Ints:
    """Order times of waveforms, to a thousandth of a sample."""
    return np.rint(time * 1024).astype(np.int64) + 1024 * shift


def _of_block(
    distance: Floats, energy: Floats, counts: Ints, digitizer: Digitizer
) -> tuple[Ints, _Found]:
    sigma = digitizer.sigma
    when = digitizer.samples(distance)
    ends = np.cumsum(counts)
    first, many = first_samples(when, sigma)
    lows = first[ends - counts] - 1
    lengths = first[ends - 1] + many - lows + 1
    begins = np.cumsum(lengths) - lengths
    mine = np.repeat(np.arange(len(counts)), counts)
    shift = (begins - lows)[mine]
    samples = np.zeros(int(lengths.sum()))
    add_echoes(samples, shift, when, energy, sigma)
    waves = _Waves(samples, begins, lows, np.maximum.reduceat(samples, begins))
    find = _gaussians if digitizer.decomposes else _peaks
    until, owner, found = find(waves, sigma)
    if not len(owner):
        return np.full(len(distance), -1), found
    echo = np.minimum(np.searchsorted(until, _key(when, shift)), len(owner) - 1)
    # It is another pulse's where this one has none.
    return np.where(owner[echo] == mine, echo, -1), found


def first_samples(when: Floats, sigma: float) -> tuple[Ints, int]:
    """First sample of each echo that is not 0, and how many there are, from the times (n,)."""
    return np.ceil(when - CUT * sigma).astype(np.int64), int(2 * CUT * sigma) + 1


def add_echoes(samples: Floats, shift: Ints, when: Floats, energy: Floats, sigma: float) -> None:
    """Add echoes at times `when` (n,) to samples; `shift` (n,) are the places of time 0."""
    first, many = first_samples(when, sigma)
    time = first[:, None] + np.arange(many)
    height = energy[:, None] * exp(-0.5 * ((time - when[:, None]) / sigma) ** 2)
    place = (time + shift[:, None]).ravel()
    samples += np.bincount(place, height.ravel(), minlength=len(samples))


_NONE = np.zeros(0, np.int64), np.zeros(0, np.int64), _Found(*np.zeros((3, 0)))


def _peaks(waves: _Waves, sigma: float) -> tuple[Ints, Ints, _Found]:
    """Find local maxima: keys of the last times that belong to each, their waveforms, the echoes.

    Their times and heights are those of the Gaussian through three samples, their energies the
    areas between the lowest samples to both sides.
    """
    w = waves.samples
    middle = w[1:-1]
    at = np.flatnonzero((middle > w[:-2]) & (middle >= w[2:])) + 1
    at = at[w[at] >= FAINT * waves.tops[waves.owner(at)]]
    if not len(at):
        return _NONE
    before, here, behind = (log(w[at + step]) for step in (-1, 0, 1))
    curve = np.minimum(before - 2 * here + behind, -1e-12)
    beside = np.clip((before - behind) / (2 * curve), -0.5, 0.5)
    height = exp(here - (behind - before) ** 2 / (8 * curve))
    which = np.searchsorted(at, np.arange(len(w)), side="right") - 1
    lowest = np.flatnonzero(w == np.minimum.reduceat(w, at)[which])
    lowest = lowest[which[lowest] >= 0]
    until = lowest[np.diff(which[lowest], prepend=-1) != 0]
    area = np.bincount(np.searchsorted(until, np.arange(len(w))), w, minlength=len(at) + 1)
    energy = area[: len(at)] / (sigma * np.sqrt(2 * np.pi))
    owner = waves.owner(at)
    position = (at - waves.shift(owner)) + beside
    return 1024 * until, owner, _Found(position, energy, energy / height)


def _gaussians(waves: _Waves, sigma: float) -> tuple[Ints, Ints, _Found]:
    """Decompose waveforms into Gaussians; returns as of `_peaks`.

    There is one for each minimum of the second derivative (after Hofton et al. 2000, who take the
    points of inflection around them), none narrower than the system waveform.
    """
    w, area = waves.samples, sigma * np.sqrt(2 * np.pi)
    bent = np.zeros(len(w))
    bent[1:-1] = w[:-2] - 2 * w[1:-1] + w[2:]
    middle = bent[1:-1]
    at = np.flatnonzero((middle < bent[:-2]) & (middle <= bent[2:])) + 1
    owner = waves.owner(at)
    top = waves.tops[owner]
    some = (w[at] >= FAINT * top) & (-bent[at] * (sigma * sigma) >= CURVED * top)
    at, owner, top = at[some], owner[some], top[some]
    if not len(at):
        return _NONE
    # Pieces of waveforms that are fitted by themselves.
    piece = (np.diff(owner, prepend=-1) != 0) | (np.diff(at, prepend=-1) > APART * sigma)
    piece = np.cumsum(numbers(np.cumsum(piece)) % TOGETHER == 0) - 1
    begins, counts = runs(piece)
    later = begins[1:]
    same = owner[later] == owner[later - 1]
    cuts = np.where(same, (at[later] + at[later - 1]) // 2, waves.begins[owner[later]] - 1)
    of_sample = np.searchsorted(cuts, np.arange(len(w)))
    time = np.zeros(len(at))
    height, width = np.zeros((2, len(at)))
    for count in range(1, TOGETHER + 1):
        pieces = np.flatnonzero(counts == count)
        if not len(pieces):
            continue
        rows = begins[pieces] + np.arange(count)[:, None]  # (count, pieces)
        number = np.full(len(counts), -1)
        number[pieces] = np.arange(len(pieces))
        here = np.flatnonzero(number[of_sample] >= 0)
        mine = number[of_sample[here]]
        origin, scale = at[rows[0]], top[rows[0]]
        high = np.minimum(w[at[rows]], -bent[at[rows]] * (sigma * sigma)) / scale
        guess = np.stack([high, (at[rows] - origin) / sigma, np.ones(rows.shape)])
        fit = fitted((here - origin[mine]) / sigma, w[here] / scale[mine], mine, guess)
        # What is beyond a cut, no sample tells; so energies are those of the piece together.
        fit[0] *= np.bincount(mine, w[here]) / (fit[0] * fit[2]).sum(axis=0) / area / scale
        height[rows], width[rows] = fit[0] * scale, fit[2]
        time[rows] = fit[1] * sigma + (origin - waves.shift(owner[rows[0]]))
    kept = height >= FAINT * top
    height, time, width, owner = height[kept], time[kept], width[kept], owner[kept]
    # Each by its time, also where a fit went beyond its piece.
    order = np.lexsort((time, owner))
    height, time, width, owner = height[order], time[order], width[order], owner[order]
    apart = np.diff(owner, prepend=-1) != 0
    apart[1:] |= np.diff(time) >= CLOSE * sigma
    which = np.cumsum(apart) - 1
    each = height * width
    energy = np.bincount(which, each).astype(np.float64)
    position = np.bincount(which, each * time) / energy
    spread = width**2 + ((time - position[which]) / sigma) ** 2
    width = np.sqrt(np.bincount(which, each * spread) / energy)
    owner = owner[apart]
    until = _key((position + np.append(position[1:], 0)) / 2, waves.shift(owner))
    changes = np.flatnonzero(np.diff(owner, append=-1))
    until[changes] = 1024 * np.append(waves.begins, len(w))[owner[changes] + 1] - 1
    return until, owner, _Found(position, energy, width)


def fitted(x: Floats, y: Floats, owner: Ints, guess: Floats) -> Floats:
    """Fit sums of Gaussians by least squares: heights, places and widths, (3, k, fits).

    The method is that of Levenberg and Marquardt; a fit ends when a step gains nothing, or after
    `STEPS`. Heights are `HIGHEST` at most, places within `MOVES` of the guess, and widths, standard
    deviations, at least 1.

    Parameters
    ----------
    x, y, owner
        Places and values of samples (n,), and the fit that each belongs to, in their order.
    guess
        Where to begin, (3, k, fits).
    """
    out = guess.copy()
    _, count, fits = guess.shape
    size = 3 * count
    active = np.arange(fits)  # fits that have not ended
    best, low, high = guess, guess[1] - MOVES, guess[1] + MOVES
    begins, lengths = runs(owner)
    widest = np.maximum((x[begins + lengths - 1] - x[begins]) / (4 * count), 1.5)
    damping = np.full(fits, 1e-3)

    def misses(now: Floats) -> tuple[Floats, Floats, Floats]:
        height, place, width = now[:, :, owner]
        z = (x - place) / width
        bell = exp(-0.5 * z * z)
        rest = y.copy()
        for one in height * bell:
            rest -= one
        slopes = height * bell * z / width
        slopes = np.concatenate([bell, slopes, slopes * z])
        return rest, slopes, np.add.reduceat(rest * rest, begins)

    rest, slopes, cost = misses(best)
    for _ in range(STEPS):
        towards = np.add.reduceat(slopes * rest, begins, axis=1)
        normal = np.empty((size, size, len(active)))
        for row in range(size):
            products = slopes[row] * slopes[: row + 1]
            normal[row, : row + 1] = np.add.reduceat(products, begins, axis=1)
            normal[row, row] = normal[row, row] * (1 + damping) + 1e-12
        trial = best + _solved(normal, towards).reshape(best.shape)
        trial[0] = np.clip(trial[0], 0, HIGHEST)
        trial[1] = np.clip(trial[1], low, high)
        trial[2] = np.clip(trial[2], 1, widest)
        new_rest, new_slopes, new_cost = misses(trial)
        better = new_cost < cost
        on = ~better | (cost - new_cost > GAIN * cost)
        on &= (new_cost > ENOUGH) & (damping < 1e6)
        best = np.where(better, trial, best)
        out[:, :, active] = best
        if not on.any():
            break
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, damping / 10, damping * 10)
        mine = better[owner]
        rest, slopes = np.where(mine, new_rest, rest), np.where(mine, new_slopes, slopes)
        if not on.all():
            here = on[owner]
            owner = (np.cumsum(on) - 1)[owner[here]]
            x, y, rest, slopes = x[here], y[here], rest[here], slopes[:, here]
            begins, _ = runs(owner)
            active, best, cost, damping = active[on], best[:, :, on], cost[on], damping[on]
            low, high, widest = low[:, on], high[:, on], widest[on]
    return out


def _solved(normal: Floats, right: Floats) -> Floats:
    """Solve symmetric equations, of which the lower half is read: (n, n, fits) and (n, fits)."""
    size = len(right)
    lower = np.zeros_like(normal)
    for column in range(size):
        for row in range(column, size):
            left = normal[row, column].copy()
            for k in range(column):
                left -= lower[row, k] * lower[column, k]
            if row == column:
                lower[row, row] = np.sqrt(np.maximum(left, 1e-30))
            else:
                lower[row, column] = left / lower[column, column]
    out = right.copy()
    for row in range(size):
        for k in range(row):
            out[row] -= lower[row, k] * out[k]
        out[row] /= lower[row, row]
    for row in reversed(range(size)):
        for k in range(row + 1, size):
            out[row] -= lower[k, row] * out[k]
        out[row] /= lower[row, row]
    return out


def recorded(
    hits: Hits,
    returns: Hits,
    digitizer: Digitizer,
    each: int,
    count: int,
    noise: tuple[float, int, Keys] | None = None,
) -> Records:
    """Record the waveform around each return, `count` samples: (n,), see `record`.

    A window begins where the echo of its first return does, and returns of the same pulse share it
    as long as their echoes end within. Windows of a pulse that overlap hold the same samples.

    Parameters
    ----------
    hits
        Of all sub-rays, `each` of a beam, in the order of rays.
    returns
        Their `ray` is the beam, in order.
    noise
        Standard deviation of a sample, the seed, and the keys of beams.
    """
    out = np.zeros(len(returns.ray), record(count))
    out["sample_ps"] = round(1000 * digitizer.sample_ns)
    when = digitizer.samples(returns.distance)
    first = np.maximum(np.floor(when).astype(np.int64) - digitizer.reach, 0)
    last = np.ceil(when).astype(np.int64) + digitizer.reach
    place = numbers(returns.ray)
    begin = first.copy()
    for number in range(1, int(place.max(initial=0)) + 1):
        rows = np.flatnonzero(place == number)
        shared = (last[rows] < begin[rows - 1] + count) & (first[rows] >= begin[rows - 1])
        begin[rows] = np.where(shared, begin[rows - 1], first[rows])
    new = (place == 0) | (np.diff(begin, prepend=-1) != 0)
    window = np.cumsum(new) - 1
    beam, begins = returns.ray[new], begin[new]
    low, high = (np.searchsorted(hits.ray, (beam + step) * each) for step in (0, 1))
    unit = max(count, each * (2 * digitizer.reach + 1))
    size = max(1, BLOCK_SAMPLES // unit)
    out["begin"] = begin
    for start in range(0, len(beam), size):
        block = slice(start, start + size)
        samples = _window(hits, digitizer, each, begins[block], low[block], high[block], count)
        if noise is not None:
            sigma, seed, keys = noise
            scan, ray = keys.of(beam[block])
            stream = raw(seed, Purpose.SAMPLES, scan, ray)[:, None]
            number = begins[block, None] + np.arange(count)
            samples += sigma * normal(seed, Purpose.SAMPLE, stream, number >> 8, number & 255)
        steps, exponents = digitised(samples)
        low_row, high_row = np.searchsorted(window, [start, start + size])
        mine = window[low_row:high_row] - start
        out["samples"][low_row:high_row] = steps[mine]
        out["exponent"][low_row:high_row] = exponents[mine]
    return out


def _window(
    hits: Hits, digitizer: Digitizer, each: int, begins: Ints, low: Ints, high: Ints, count: int
) -> Floats:
    """Sample the waveforms of some windows, of the hits from `low` to `high`: (windows, count)."""
    sizes = high - low
    mine = np.repeat(np.arange(len(begins)), sizes)
    rows = np.arange(len(mine)) + np.repeat(low - np.cumsum(sizes) + sizes, sizes)
    when = digitizer.samples(hits.distance[rows])
    first, many = first_samples(when, digitizer.sigma)
    time = first[:, None] + np.arange(many)
    height = exp(-0.5 * ((time - when[:, None]) / digitizer.sigma) ** 2)
    height *= hits.energy[rows, None] / each
    place = time - begins[mine, None]
    inside = (place >= 0) & (place < count)
    place += count * mine[:, None]
    samples = np.bincount(place[inside], height[inside], minlength=len(begins) * count)
    return samples.reshape(len(begins), count).astype(np.float64)


def digitised(samples: Floats) -> tuple[NDArray[np.uint16], NDArray[np.int8]]:
    """Round samples (n, k) to whole numbers from `ZERO`, of a power of two that holds all of each.

    Returns them, uint16 (n, k), and the exponents (n,).
    """
    most = np.maximum(samples.max(axis=1) / (65_535 - ZERO), -samples.min(axis=1) / ZERO)
    _, exponents = np.frexp(most)
    exponents = np.clip(np.where(most > 0, exponents, SILENT), SILENT, 127)
    steps = np.rint(np.ldexp(samples, -exponents[:, None])) + ZERO
    return np.clip(steps, 0, 65_535).astype(np.uint16), exponents.astype(np.int8)
