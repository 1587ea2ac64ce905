"""What a run would do and need, found out without starting anything."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dask.system import CPU_COUNT
from dask.utils import format_bytes
from distributed import Client
from distributed.system import MEMORY_LIMIT

from lidarsim.base.errors import LidarError, Mistakes
from lidarsim.base.storage import Storage
from lidarsim.base.words import plural
from lidarsim.columns.cloud import CHUNK_POINTS
from lidarsim.scene.actors import shapes_of
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import DRAWN_TRIANGLES
from lidarsim.sensor import Survey
from lidarsim.simulator.memory import MB, cast_bytes, scans_that_fit
from lidarsim.simulator.rig import PATTERN_RAYS
from lidarsim.simulator.sampling import sample_survey
from lidarsim.simulator.scene_caster import check_backend_here
from poolpart import Pool
from poolpart.probe import visible_gpus
from raybeam import available_backends

from ..export.navigation_files import instrument_bytes
from ..report.output import ROOM_BYTES, SurveyOutput
from ..run.cluster.checks import check_memory, check_workers, find_workers, gpu_note, slots_needed
from ..run.cluster.connection import default_workers
from ..run.job_source import identity_of
from ..run.options import RunOptions
from ..run.pipeline.names import GPU, LIDAR, OTHER
from ..run.pipeline.policies import most_scans
from ..run.store.database import FILE
from ..run.store.run_store import RUN_FOLDER
from ..scenario.advice import advice
from ..scenario.build import Job, build
from ..scenario.campaign import CampaignSpec, is_campaign
from ..scenario.empty_cloud import EMPTY, empty_cloud_reason
from ..scenario.plausibility import implausibilities
from ..scenario.scenario import Scenario
from .terminal import Terminal

# Measured on Linux: a process of ours with Dask loaded, and the most that a triangle takes while a
# caster is built (Embree 300, NumPy 350, CUDA 360).
PROCESS_BYTES = 300 << 20  # 110 MiB of these for numba, which compiles what calls Embree
TRIANGLE_BYTES = 360
SCENE_BYTES = 80  # of a triangle, in every process that knows the scene
COLOURED_BYTES = 160  # of a triangle with colours, and four times the bytes of images
COPY_BYTES = 2000  # of an instance, likewise
POSE_BYTES = 40  # of a triangle in each pose of an animation: boxes of a tree; vertices have 24
RAY_BYTES = 48  # of a turn, and of the pattern made of it
PARTICLE_BYTES = 140  # of a swarm, for each corner of its path
PART_BYTES = 2500  # its head, and its row in the database
FIRST_PARTS = 60  # of a scan or a few, taken before batches become large
SCAN_BYTES = 64  # in the driver
WAY_POSES = 1000  # that the length of a way is measured by
SUMMARY_BYTES = 28  # of a scan, in the database
FORMAT_BYTES = 30  # of a point in an exported file, beside its columns, at most: LAS
_FINE = 1e-6  # edges below this share of a mesh's size are beyond float32

LOOKED_AT = 5  # jobs of a campaign


def look_at(
    path: Path,
    of_mesh: Mapping[str, Any],
    number: int | None,
    client: Client | None,
    options: RunOptions,
    backend: str | None,
    *,
    no_plan: bool,
    quiet: bool,
) -> tuple[dict[str, Any], Iterator[str]]:
    """Find out what the run of a scenario, a campaign or one of its jobs would do and need.

    `of_mesh` are for `mesh_data`. Of a campaign, some jobs are looked at, the first and the
    last among them; they plan no paths.

    Returns
    -------
    Plain data for JSON, and the same as lines of text.
    """
    campaign = CampaignSpec.load(path) if not of_mesh and is_campaign(path) else None
    if campaign is None and number is not None:
        raise LidarError(f"{path} is no campaign, and has no job {number}.")

    terminal = Terminal(quiet)

    def look(one: int = 0) -> tuple[Job, dict[str, Any]]:
        read = Scenario.load(path, of_mesh) if campaign is None else campaign.scenario(one)
        assert read is not None, "of a file"
        with terminal.status("reading the scene", logged=False):
            built = build(read, plans=campaign is None and not no_plan)
            job = built.job()
        with terminal.status("casting some rays"):
            found = forecast(job, options.with_pool(read.pool, {"backend": backend}), client)
        found["notes"] += advice(built)
        found["warnings"] += implausibilities(built)
        if campaign is not None:
            found["notes"] += campaign.keep.of_jobs.contradictions(read.cloud.coordinates)
        found["sources"] = dict(built.found.sources)
        if campaign is not None:
            own = {"number": one, "name": campaign.name(one), "split": campaign.split(one)}
            names = ("objects", "triangles", "scans", "rays", "estimate")
            own |= {"values": campaign.values(one)} | {name: found[name] for name in names}
            found["job"] = own
        return job, found

    if campaign is None or number is not None:
        job, found = look(number or 0)
        return found, _of_job(job, found)
    campaign.check_files()
    jobs, notes, warnings, mistakes = [], list[str](), list[str](), Mistakes()
    for one in dict.fromkeys((campaign.count - 1) * i // (LOOKED_AT - 1) for i in range(LOOKED_AT)):
        with mistakes.noted():
            _, found = look(one)
            jobs.append(found["job"])
            notes += found["notes"]
            warnings += found["warnings"]
            mistakes.lines += found["reasons"]
    found = {
        "can_run": not mistakes.lines,
        "reasons": list(dict.fromkeys(mistakes.lines)),
        "occupied": _holds_files(options.out),
        "notes": list(dict.fromkeys(notes)),
        "warnings": list(dict.fromkeys(warnings)),
        "count": campaign.count,
        "seed": campaign.seed,
        "choices": dict(campaign.choices),
        "splits": dict(campaign.splits),
        "keep": asdict(campaign.keep),
        "jobs": jobs,
    }
    return found, _of_campaign(campaign, found)


def forecast(job: Job, options: RunOptions, client: Client | None = None) -> dict[str, Any]:
    """Find out what the run of a survey would do and need, and whether it can run.

    It runs on the cluster of `client`, on the one that `options` describe, or on one of this
    machine. Neither of the latter is started, and the folder of the result is only looked at.

    Returns
    -------
    dict
        Plain data for JSON, sizes in bytes. `reasons` say why it cannot run, each with what to
        do. `memory` is of all processes on this machine, or, on another cluster, of a GPU worker.
    """
    out, formats = options.out, job.outputs
    assert out is not None, "commands write"
    mistakes, notes, warnings = Mistakes(), list[str](), list[str]()
    with mistakes.noted():
        notes += _look_at_folder(out)
    occupied = bool(notes)  # an unfinished run
    try:
        SurveyOutput(out, job.survey, formats).refuse(lambda: identity_of(job))
    except LidarError as error:
        notes.append(str(error).rstrip("."))
        occupied = True
    for one in formats:
        with mistakes.noted():
            one.check_installed()
    cluster = _look_at_cluster(job, options, client, mistakes, notes)
    slots, casters, backend = cluster.slots, cluster.casters, cluster.backend
    estimate = None
    # Casting here needs as much memory as on a worker: it would fail or be killed.
    if _worker_bytes(job) + cast_bytes(job.scene, job.survey) <= MEMORY_LIMIT:
        estimate = sample_survey(job.scene, job.survey)
        if not estimate["hits"]:
            warnings.append(f"{EMPTY}: {empty_cloud_reason(job.scene, job.survey)}")
    if backend == "embree":
        notes += _of_fine_triangles(job.scene)
    # Without an estimate every ray may hit.
    points = estimate["points"] if estimate else job.survey.ray_count // job.survey.keep_every
    # Scans of the largest batches; small ones take less.
    fit = scans_that_fit(job.scene, job.survey, options.batch_mb * MB, on_device=backend == "cuda")
    batch = most_scans(fit, job.survey.scan_count, max(1, slots[GPU]["there"]))
    disk = _disk(job, points, batch, len(formats), out)
    stored = isinstance(out, Storage)
    if disk["free"] < (least := disk["result"] + (0 if stored else disk["parts"])):
        mistakes.lines.append(
            f"The disk of {disk['folder']} has {format_bytes(disk['free'])} free, and the run "
            f"needs about {format_bytes(least)}: make room, name another folder with "
            f"{'TMPDIR' if stored else '--out'}, or take a larger keep_every."
        )
    needed = _bytes_needed(job, points, batch, cluster, local=options.own and client is None)
    if cluster.memory and cluster.memory < needed:
        mistakes.lines.append(
            f"There are {format_bytes(cluster.memory)} of memory, and the run needs about "
            f"{format_bytes(needed)}: take a smaller scene, fewer casting workers (pool.gpu), a "
            "smaller batch_mb, rays_per_revolution or planning.particles, or a machine with more."
        )
    return {
        "can_run": not mistakes.lines,
        "reasons": mistakes.lines,
        "occupied": occupied,  # whether the place of the result holds another one
        "notes": notes,
        "warnings": warnings,
        "objects": len(job.scene.all_names),
        "triangles": job.scene.triangles,
        "masked": list(job.scene.masked),
        "bounds": (job.scene.bounds + job.scene.origin).tolist(),
        "poses": job.survey.path.stations,
        "drive": _drive(job.survey),
        "scans": job.survey.scan_count,
        "rays": job.survey.ray_count,
        "estimate": estimate,
        "precision_m": job.survey.precision_m,
        "trials": job.trials,
        "backend": backend,
        "casters": casters,
        "slots": slots,
        "memory": {"needed": needed, "there": cluster.memory or None},
        "disk": disk,
    }


class _Cluster(NamedTuple):
    """What a run would have to cast on."""

    slots: dict[str, dict[str, int]]  # {partition: {"needed": …, "there": …}}
    casters: int
    backend: str | None  # None if it is not known yet
    memory: int  # bytes; 0 for machines that are not there yet


def _look_at_cluster(
    job: Job, options: RunOptions, client: Client | None, mistakes: Mistakes, notes: list[str]
) -> _Cluster:
    """Look at the cluster of `client`, or at what `options` describe."""
    required = slots_needed(options, planning=job.planning is not None)
    casting, backend = None, None
    memory = 0  # that of machines that are not there yet is unknown
    if (file := options.cluster) is not None:
        there = file.slots
        with mistakes.noted():
            file.require(required)
    elif client is not None:
        held = [worker.resources for worker in Pool.from_client(client)]
        there = {name: int(sum(slots.get(name, 0) for slots in held)) for name in required}
        with mistakes.noted():
            everybody, casting, backend, _ = find_workers(client, required, options.backend)
            check_workers(job, options, backend, casting)
            memory = min((worker.memory for worker in casting if worker.memory), default=0)
            notes += filter(None, [gpu_note(everybody, casting, backend)])
    else:
        workers = default_workers(CPU_COUNT, len(visible_gpus()))
        there = {GPU: options.gpu_workers or workers[GPU]}
        there[OTHER] = options.other_workers or workers[OTHER]
        there[LIDAR] = required[LIDAR]  # one worker with as many threads
        memory = MEMORY_LIMIT
        with mistakes.noted():
            check_backend_here(options.backend)
            usable = [name for name, reason in available_backends().items() if not reason]
            backend = usable[0] if options.backend == "auto" else options.backend
            # Dask gives each worker of a local cluster its share of the memory.
            each = MEMORY_LIMIT / CPU_COUNT
            check_memory(job, options, backend, each, "a casting worker of this machine")
    slots = {n: {"needed": least, "there": there.get(n, 0)} for n, least in required.items()}
    casters = slots[GPU]["there"] if casting is None else len(casting)
    return _Cluster(slots, casters, backend, memory)


def _bytes_needed(job: Job, points: int, batch: int, cluster: _Cluster, *, local: bool) -> int:
    """Memory of a casting worker, or if the cluster is local of all its processes."""
    on_device = cluster.backend == "cuda"
    worker = _worker_bytes(job) + cast_bytes(job.scene, job.survey, batch, on_device=on_device)
    return worker * cluster.casters + _rest_bytes(job, points, cluster.slots) if local else worker


def _disk(job: Job, points: int, batch: int, exports: int, out: Path | Storage) -> dict[str, Any]:
    """Disk that parts and database need during the run, that the result needs, and what is free.

    Later parts are of `batch` scans.
    """
    survey, faces, point = job.survey, job.scene.kept_triangles, _point_bytes(job)
    full = -(-survey.scan_count // batch)
    parts = min(survey.scan_count, full + FIRST_PARTS)
    # Each part names the triangles that its rays hit.
    tally = 12 * min(faces, survey.ray_count // full // 10) * full
    run = point * points + PART_BYTES * parts + tally + SUMMARY_BYTES * survey.scan_count
    # A row of the PLY has doubles for coordinates at most; one piece exists twice.
    cloud = (point + 16) * (points + min(points, CHUNK_POINTS))
    result = cloud + (point + FORMAT_BYTES) * points * exports + ROOM_BYTES + 36 * faces
    result += instrument_bytes(survey, exports)
    # What goes into storage is made in a folder for temporary files, but for the parts.
    folder = Path(tempfile.gettempdir()) if isinstance(out, Storage) else out
    free = shutil.disk_usage(_existing(folder)).free
    return {"parts": run, "result": result, "free": free, "folder": str(folder)}


def _drive(survey: Survey) -> dict[str, Any] | None:
    """Describe how far a moving carrier goes, and the turns of each sensor."""
    if not survey.path.moves:
        return None
    seconds = survey.duration_ns / 1e9
    places, _ = survey.path.poses(0, np.linspace(0, survey.duration_ns, WAY_POSES))
    metres = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    sensors = []
    for carried, steps in zip(survey.carried, survey.steps_each, strict=True):
        sensor, name = carried.sensor, carried.name
        firings = sensor.firings(steps - 1)[1]
        rate_hz = getattr(sensor.head, "rate_hz", None)
        on_ns = sensor.begins_ns(np.array([firings])).item() - sensor.start_ns
        sensors.append({
            "name": name, "model": sensor.model, "cycle": sensor.cycle,
            "scans": steps * survey.path.stations, "firings": firings * survey.path.stations,
            "turns": rate_hz and on_ns / 1e9 * rate_hz,
            "metres_a_turn": rate_hz and metres / seconds / rate_hz,
        })  # fmt: skip
    return {"seconds": seconds, "metres": metres, "sensors": sensors}


def _existing(out: Path) -> Path:
    """Return the folder itself, or its innermost existing parent."""
    return next(path for path in (out, *out.absolute().parents) if path.exists())


def _of_fine_triangles(scene: Scene) -> list[str]:
    """Return a note on triangles that Embree may miss, since it finds them in float32."""
    count, least = 0, _FINE * np.ptp(scene.bounds, axis=0).max()
    parts = scene.instances.parts if scene.instances else ()
    for points, faces in ((scene.vertices, scene.faces), *((p.vertices, p.faces) for p in parts)):
        corners = points[faces.T]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=2).min(axis=0)
        # Without an area no backend hits them.
        count += int(((edges > 0) & (edges < least)).sum())
    note = "with an edge below a millionth of the scene may be missed by embree, not by numpy"
    return [f"{plural(count, 'triangle')} {note}"] if count else []


def _holds_files(out: Path | Storage | None) -> bool:
    """Whether there are files where the result would be."""
    with suppress(NotADirectoryError):
        return bool(out and Storage.at(out).entries())
    return False


def _look_at_folder(out: Path | Storage) -> list[str]:
    """Return notes on the place of the result; LidarError if it cannot be written there."""
    if isinstance(out, Storage):
        out.claim()  # leaves nothing
    elif not (there := _existing(out)).is_dir():
        raise LidarError(f"{there} is a file: give a folder for the results with --out.")
    elif not os.access(there, os.W_OK | os.X_OK):
        raise LidarError(f"Cannot write to the folder {there}: give another with --out.")
    unfinished = FILE in Storage.at(out).below(RUN_FOLDER).sizes()
    note = f"{out} holds an unfinished run: --resume continues it, --fresh deletes it"
    return [note] if unfinished else []


def _worker_bytes(job: Job) -> int:
    """Memory of a GPU worker, without what it casts."""
    patterns = 0
    for carried in job.survey.carried:
        sensor = carried.sensor
        patterns += RAY_BYTES * min((sensor.period or 0) * sensor.channels, PATTERN_RAYS)
    triangles = (SCENE_BYTES + TRIANGLE_BYTES) * job.scene.kept_triangles
    images = {id(one): one.nbytes for each in job.scene.coloured for one in each.images}
    copies = COPY_BYTES * len(job.scene.instances or ())
    coloured = COLOURED_BYTES * sum(map(len, job.scene.coloured)) + 4 * sum(images.values())
    meshes, _ = shapes_of(job.scene.actors)
    poses = sum(
        mesh.animation.vertices.nbytes + POSE_BYTES * len(mesh.animation.vertices) * len(mesh.faces)
        for mesh in meshes
        if mesh.animation
    )
    return PROCESS_BYTES + triangles + coloured + copies + patterns + poses


def _rest_bytes(job: Job, points: int, slots: dict[str, dict[str, int]]) -> int:
    """Memory of the driver and of all workers but those of GPU, on one machine."""
    scene = job.scene
    swarm = job.planning.particles * job.planning.waypoints if job.planning else 0
    planning = PROCESS_BYTES + PARTICLE_BYTES * swarm
    piece = 6 * (_point_bytes(job) + 24) * min(points, CHUNK_POINTS)  # merged, written, read back
    shown = scene.kept_triangles + DRAWN_TRIANGLES
    if not scene.masked:  # which is cut into more
        shown = min(scene.triangles, shown)
    driver = 2 * SCENE_BYTES * shown + COPY_BYTES * len(scene.instances or ()) + piece
    driver += SCAN_BYTES * job.survey.scan_count
    return planning * slots.get(OTHER, {"there": 0})["there"] + driver + 2 * PROCESS_BYTES


def _point_bytes(job: Job) -> int:
    return sum(np.dtype(column.dtype).itemsize for column in job.survey.stored_columns)


def _of_campaign(campaign: CampaignSpec, found: dict[str, Any]) -> Iterator[str]:
    """Print what was found out of a campaign as lines of text."""
    kept = campaign.keep.format + f", {campaign.keep.layout}" * (campaign.keep.format == "mcap")
    yield f"campaign    {plural(campaign.count, 'job')}, seed {campaign.seed}, kept as {kept}"
    for name, words in campaign.choices.items():
        yield f"varied      {name}: {words}"
    if campaign.splits:
        shares = ", ".join(f"{name} {share:.4g}" for name, share in campaign.splits.items())
        yield f"splits      {shares}"
    for job in found["jobs"]:
        yield f"job         {_in_words(job)}"
        points = ""
        if job["estimate"]:
            points = f", about {job['estimate']['points']:,} points"
        yield (
            f"            {plural(job['objects'], 'object')}, {plural(job['scans'], 'scan')}, "
            f"{job['rays']:,} rays{points}"
        )
    if found["jobs"]:
        share = campaign.count / len(found["jobs"])
        scans = round(share * sum(job["scans"] for job in found["jobs"]))
        rays = round(share * sum(job["rays"] for job in found["jobs"]))
        points = sum((job["estimate"] or {"points": 0})["points"] for job in found["jobs"])
        yield (
            f"in all      about {scans:,} scans, {rays:,} rays and {round(share * points):,} "
            f"points, estimated from {plural(len(found['jobs']), 'job')}"
        )
    yield from _remarks(found)


def _remarks(found: dict[str, Any]) -> Iterator[str]:
    """Print notes and warnings as lines of text."""
    for note in found["notes"]:
        yield f"note: {note}"
    for warning in found["warnings"]:
        yield f"warning: {warning}"


def _in_words(job: dict[str, Any]) -> str:
    shown = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in job["values"].items()}
    values = ", ".join(f"{name} {value}" for name, value in shown.items())
    split = f" ({job['split']})" if job["split"] else ""
    return f"{job['name']}{split}{': ' if values else ''}{values}"


def _of_job(job: Job, found: dict[str, Any]) -> Iterator[str]:
    """Print a forecast as lines of text."""
    sensor, estimate, disk = job.survey.sensor, found["estimate"], found["disk"]
    if "job" in found:
        yield f"job         {_in_words(found['job'])}"
    turn = f"{sensor.channels:,} a firing"
    if len(job.survey.carried) > 1:
        turn = f"{len(job.survey.carried)} sensors"
    elif sensor.period is not None and sensor.cycle != "frame":
        turn = f"{sensor.period:,} x {sensor.channels:,} a {sensor.cycle}"
    yield f"scene       {', '.join(plural(found[f'{n}s'], n) for n in ('object', 'triangle'))}"
    for file, taken in found["sources"].items():
        yield f"file        {file}: {taken}"
    sides = list(zip("xyz", *found["bounds"], strict=True))
    spans = ", ".join(f"{axis} {low:,.2f} to {high:,.2f}" for axis, low, high in sides)
    yield f"size        {' x '.join(f'{high - low:,.2f}' for _, low, high in sides)} m; {spans}"
    if masked := found["masked"]:
        shown = ", ".join(masked[:3]) + ", …" * (len(masked) > 3)
        have = plural(len(masked), "object has masks", "objects have masks")
        yield f"masks       {have}: {shown}"
    drive = found["drive"]
    where = "along a trajectory" if drive else f"from {plural(found['poses'], 'pose')}"
    yield f"survey      {plural(found['scans'], 'scan')} {where}, {found['rays']:,} rays ({turn})"
    if drive:
        yield f"trajectory  {drive['metres']:,.2f} m in {drive['seconds']:,.3f} s"
        for one in drive["sensors"]:
            turns = ""
            if one["turns"]:
                turns = f", {one['turns']:,.2f} {one['cycle']}s; in one the carrier moves "
                turns += f"{one['metres_a_turn']:,.3f} m"
            firings = plural(one["firings"], "firing")
            yield f"{one['name'] or 'sensor':<11} {one['model']}, {firings}{turns}"
    returns = job.survey.returns_each[0]
    if drive or returns != type(returns)():
        rays = f", {returns.subrays} sub-rays a beam" if returns.subrays > 1 else ""
        yield f"returns     {returns.mode} of each pulse{rays}"
    if alpha := job.survey.extinction(sensor):
        left = f"{100 * math.exp(-100 * alpha):.2g} % of the light from 50 m is left"
        yield f"air         takes {1000 * alpha:.3g}/km: {left}"
    if estimate:
        without = job.survey.faults and 2 * estimate["rays"] < job.survey.ray_count
        yield (
            f"points      about {estimate['points']:,} of {estimate['hits']:,} hits, rounded to "
            f"{job.survey.precision_m:g} m; an estimate from {estimate['rays']:,} rays cast here"
            f"{', without faults' if without else ''}"
        )
    yield f"planning    {f'{job.trials:,} trials' if job.trials else 'none'}"
    backend = found["backend"]
    device = {None: "backend not known yet", "cuda": "GPU, cuda"}.get(backend, f"CPU, {backend}")
    yield f"cast by     {plural(found['casters'], 'casting worker')} ({device})"
    for name, slots in found["slots"].items():
        # The partition is called GPU, also where its workers have none.
        label, of = ("casting", " of partition GPU") if name == GPU else (name, "")
        count = plural(slots["there"], "slot")
        yield f"{label:<10}  {count}{of}, at least {slots['needed']:,} needed"
    there = found["memory"]["there"]
    limit = f" of {format_bytes(there)}" if there else ""
    yield f"memory      about {format_bytes(found['memory']['needed'])}{limit}"
    parts, result, free = (format_bytes(disk[name]) for name in ("parts", "result", "free"))
    yield f"disk        about {parts} during the run and {result} for the result; {free} free"
    yield from _remarks(found)
