"""Augmented sweeps as a simulation could return them, but with simple rules."""

import numpy as np

from lidarfiles.clouds.boxes import SweepBoxes
from lidarfiles.work.publishing import publishing
from lidarreal.augmentation.augmented_sweep import AugmentedSweep
from lidarreal.augmentation.rewriting.rewriter import EncodedSweeps

INTENSITY = 0.25  # of each added point
NAMES = ("Inserted car 1", "walker 2")
TYPES = ("car", "walker")


def identity(recording, number):
    """Return the recorded sweep."""
    sweep = recording[number]
    count = len(sweep)
    columns = {**sweep.columns, "cause": np.zeros(count, np.uint8)}
    return AugmentedSweep(sweep.replace(columns=columns), np.arange(count), np.ones(count, bool))


def changed(recording, number, boxes=None, visibility=(), objects=None, returns_only=False):
    """Remove every third point, halve the intensity of the others, and add some in front of them.

    Every fifth of the remaining points has an added point at half of its distance. Added points
    belong to the boxes in turn.
    """
    sweep = recording[number]
    rows = np.arange(len(sweep))
    kept = rows[rows % 3 != 0]
    if returns_only:
        kept = kept[sweep.has_return[kept]]
    added = kept[::5]
    template = np.concatenate([kept, added])
    is_recorded = np.arange(len(template)) < len(kept)
    points = np.asarray(sweep.points, np.float64)[template]
    points[~is_recorded] /= 2
    columns = {name: np.asarray(values)[template] for name, values in sweep.columns.items()}
    strength = "intensity" if "intensity" in columns else "reflectivity"
    intensity = columns[strength].astype(np.float64) / 2
    intensity[~is_recorded] = INTENSITY if columns[strength].dtype.kind == "f" else 25
    columns[strength] = intensity
    columns["cause"] = np.where(is_recorded, 0, 1).astype(np.uint8)
    if boxes is not None and len(boxes):
        turn = np.arange(len(added)) % len(boxes)
        columns["cause"][:] = 0
        if "object" in columns:
            columns["object"][~is_recorded] = boxes.objects[turn]
        if "class" in columns:
            columns["class"][~is_recorded] = 40 + turn
    order = np.argsort(template, kind="stable")
    columns = {name: values[order] for name, values in columns.items()}
    augmented = sweep.replace(points=points[order], columns=columns)
    more = {} if boxes is None else {"boxes": boxes, "visibility": np.asarray(visibility)}
    return AugmentedSweep(augmented, template[order], is_recorded[order], **more)


def two_boxes(first_object=50, points=(12, 0)):
    """Return the boxes of a car ahead, turned by 90 degrees, and of a walker to the left."""
    half = np.sqrt(0.5)
    return SweepBoxes(
        NAMES,
        TYPES,
        np.array([first_object, first_object + 1], np.int32),
        np.array([[10.0, 2, -1], [3, 8, -0.5]]),
        np.array([[0, 0, half, half], [0, 0, 0, 1]]),
        np.array([[4.0, 2, 1.5], [0.5, 0.5, 1.8]]),
        np.array(points),
    )


def write_sweep(rewriter, work, number, augmented):
    """Write the encoded files of a sweep to a folder."""
    for name, content in rewriter.sweep_files(number, augmented).items():
        path = EncodedSweeps(work, 0).path(number, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def finish(rewriter, target, work, others=(), *, overwrite=False):
    """Write the augmented copy of a recording, and return the notes of the rewriter."""
    rewriter.check_target(target, overwrite=overwrite)
    with publishing(target) as staged:
        return rewriter.finish(staged / target.name, work, others)


def rewrite(rewriter, target, work, augment, numbers=None, **options):
    """Encode all sweeps of a recording in any order, and return the notes of the rewriter."""
    count = len(rewriter.recording)
    for number in reversed(range(count)) if numbers is None else numbers:
        write_sweep(rewriter, work, number, augment(rewriter.recording, number))
    return finish(rewriter, target, work, **options)


def content(folder):
    """Return the content of all files in a folder, except the mark of the rewriter."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lidarpool-augmented"
    }
