"""The `lidarpool flight` command, which plans the flight lines of an airborne survey."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.words import format_rounded

from . import completion
from . import shared_options as options
from .first_step import print_first_step
from .planned_scene import (
    carried_sections,
    comment_lines,
    planned_columns,
    prepared_with_notes,
    sensor_entry,
)
from .shared_options import overwrite

if TYPE_CHECKING:
    from lidarscenario.plan.flight import FlightPlan
    from lidarscenario.plan.flight_area import Area
    from lidarscenario.plan.flight_density import AreaDensity
    from lidarscenario.scenario import Scenario
    from lidarsim.numerics.arrays import Floats

    from .terminal import Terminal

SCENARIO_FILE = "flight.yaml"
PATH_FILE = "path.csv"
PICTURE_FILE = "flight.png"
GEOJSON_FILE = "flight.geojson"
KML_FILE = "flight.kml"
FILES = (SCENARIO_FILE, PATH_FILE, PICTURE_FILE, GEOJSON_FILE, KML_FILE)
_FORMATS = ("laz",)  # formats to which the results of plans are exported
_SHOWN_LINES = 20  # maximum number of lines listed individually
_STEP_DEG = 360  # time step in degrees of the scanner's cycle, so one cycle per scan
_STEP_RAYS = 100_000  # a cycle with more rays is divided into steps of 10 degrees
# Level ground extends beyond the trajectory by this multiple of half the swath.
_GROUND_MARGIN = 1.5
_MIN_MARGIN_M = 50
_MIN_PERCENTAGE = 5  # Larger overlaps without a percent sign are percentages.
_NEGATIVE_BOUNDS = re.compile(r"-[\d.]+,")
_ORIGIN_M = 100.0  # the origin of a plan in a UTM zone is a multiple of this length


def _parse_overlap(text: str) -> float:
    """Parse a percentage such as 30% or 30, or a fraction such as 0.3."""
    try:
        fraction = float(text.removesuffix("%"))
    except ValueError:
        fraction = math.nan
    if text.endswith("%") or fraction >= _MIN_PERCENTAGE:
        fraction /= 100
    if not (0 <= fraction <= 0.95):
        raise click.BadParameter(
            f"{text!r} is not a valid overlap. Expected a value from 0% to 95%, such as 30%."
        )
    return fraction


def _parse_speeds(text: str) -> tuple[float, float]:
    """Parse a speed such as 8, or its limits such as 4-12."""
    try:
        low, _, high = text.partition("-")
        speeds = float(low), float(high or low)
    except ValueError:
        speeds = math.nan, math.nan
    if speeds[0] > speeds[1]:
        raise click.BadParameter(
            f"{text!r} is not a valid speed range, because the lower limit must come first. Use "
            f"`--speed {high}-{low}`."
        )
    if not 0.1 <= speeds[0] <= speeds[1] <= 400:
        raise click.BadParameter(
            f"{text!r} is not a valid speed. Expected a speed from 0.1 to 400 m/s such as 8, or "
            "its limits such as 4-12."
        )
    return speeds


class _FlightCommand(click.Command):
    """A command whose arguments can be bounds that start with a minus sign."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Prefix such bounds with a space, so that they are not parsed as options."""
        return super().parse_args(
            ctx, [f" {text}" if _NEGATIVE_BOUNDS.match(text) else text for text in args]
        )


@click.command(cls=_FlightCommand, context_settings={"show_default": True})
@click.argument("area", metavar="AREA")
@click.option(
    "--sensor",
    "model",
    metavar="MODEL|FILE.yaml",
    required=True,
    shell_complete=completion.sensors,
    help="Sensor model, as listed by lidarpool sensors, with or without its manufacturer, or a "
    "sensor file.",
)
@options.path(
    "--terrain",
    "terrain",
    help="Mesh, height raster or scenario with the ground (default: AREA if it is a mesh, "
    "otherwise level ground at a height of 0).",
)
@click.option(
    "--agl",
    "agl_m",
    type=options.Number(0, 20_000, min_open=True),
    required=True,
    metavar="M",
    help="Height of the aircraft above the mean ground below each line, in meters.",
)
@click.option(
    "--overlap",
    type=_parse_overlap,
    default="30%",
    metavar="SHARE",
    help="Overlap of adjacent strips as a share of the swath.",
)
@click.option(
    "--density",
    "density_m2",
    type=options.Number(0, 1e5, min_open=True),
    metavar="N",
    help="Number of points per square meter in each strip (default: the density at the maximum "
    "speed and pulse rate).",
)
@click.option(
    "--speed",
    "speeds_m_s",
    type=_parse_speeds,
    default="3-70",
    metavar="M/S",
    help="Speed over ground in m/s, or a range from which it is chosen.",
)
@click.option(
    "--fov",
    "fov_deg",
    type=options.Number(1, 170),
    metavar="DEG",
    help="Planned field of view across the track in degrees (default: that of the sensor, at most "
    "90).",
)
@click.option(
    "--heading",
    "heading_deg",
    type=options.Number(-360, 360),
    metavar="DEG",
    help="Direction of the lines in degrees clockwise from north (default: along the longest "
    "side of the area).",
)
@click.option(
    "--cross",
    type=click.IntRange(0, 100),
    default=0,
    help="Number of cross strips, which are perpendicular to the other lines.",
)
@options.flag("--follow", help="Follow the terrain along each line instead of flying level.")
@click.option(
    "--epsg",
    type=click.IntRange(1024, 32767),
    metavar="CODE",
    help="EPSG code of the terrain, and of an area in WKT or bounds (default: from the terrain, or "
    "the UTM zone of a GeoJSON area).",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Output folder for the scenario, the path and the maps (default: named after the area).",
)
@options.mesh_reading
@overwrite
@options.as_json
def flight(area: str, model: str, of_mesh: dict[str, Any], **settings: Any) -> None:
    """Plan the flight lines of an airborne survey.

    AREA is a polygon in a GeoJSON file or in WKT, bounds such as 0,0,400,200, or a mesh or scenario
    whose extent is the area. GeoJSON contains longitudes and latitudes. WKT and bounds are in the
    coordinates of the terrain, in meters.

    The lines are parallel to the longest side of the area, and spaced so that adjacent strips have
    the requested overlap. The speed, the pulse rate and the scan frequency are chosen within the
    limits of the sensor so that each strip has the requested density. The output is a scenario for
    `lidarpool run`, a map with the expected density, and the plan as GeoJSON and KML. Notes state
    which requirements cannot be met, and what to change.

    \b
    Examples:
      lidarpool flight hills.ply --sensor riegl-vq780i --agl 700 --density 20
      lidarpool flight site.geojson --sensor vq780i.yaml --terrain dem.tif --agl 500 --follow
      lidarpool flight 0,0,400,200 --sensor riegl-vq780i --agl 150 --speed 4-12 --cross 1
    """  # noqa: D301 - Click requires the character \b
    as_json = settings.pop("as_json")
    print_first_step("reading the area", quiet=as_json)
    from lidarfiles.clouds.folder import check_not_existing, result_folder
    from lidarscenario.plan.flight import plan_flight
    from lidarscenario.plan.flight_area import read_area
    from lidarscenario.plan.flight_scanner import AirborneScanner
    from lidarsim.schema.model_names import full_name

    from .terminal import Terminal

    terminal = Terminal(quiet=as_json)
    # An unsuitable sensor and existing files are reported before the scene is read.
    scanner = AirborneScanner.load(full_name(model), settings.pop("fov_deg"))
    drawn = read_area(area)
    folder = settings.pop("out") or Path(f"{_area_name(area, drawn)}-flight")
    with result_folder(folder):
        check_not_existing((folder / name for name in FILES), overwrite=settings.pop("overwrite"))
        site = _read_site(
            area, drawn, settings.pop("terrain"), settings.pop("epsg"), of_mesh, terminal
        )
        with terminal.status("planning the flight lines"):
            plan = plan_flight(site.shape, site.terrain, scanner, **settings)
        sections, omissions = _site_sections(plan, site, folder)
        plan_notes = [*omissions, *plan.notes]
        data = sections | _plan_sections(plan, folder)
        data["cloud"] = data.pop("cloud")  # the last section, which the guide continues
        density = _write_plan(plan, site, data, plan_notes, folder, terminal)
    notes = [*site.notes, *plan_notes, *_density_notes(plan, density)]
    if site.epsg is None:
        notes.append(
            f"{KML_FILE} is not written, and {GEOJSON_FILE} contains the coordinates of the plan, "
            "because the coordinate system is unknown. Pass `--epsg`"
        )
    figures = _figures(plan, site, density, notes)
    options.print_results(figures, _lines(plan, density, notes[len(site.notes) :]), as_json)
    if not as_json:
        names = [name for name in FILES if name != KML_FILE or site.epsg]
        click.echo(f"plan in {click.format_filename(folder)}: {', '.join(names)}")
        click.echo(f"next: lidarpool check {shlex.quote(str(folder / SCENARIO_FILE))}")


class _Site(NamedTuple):
    """Area to survey and its terrain."""

    shape: Any  # Shapely polygon in scenario coordinates
    terrain: Any
    scenario: Scenario | None  # scenario with the terrain, or None for level ground
    epsg: int | None  # EPSG code of the scenario coordinates plus `origin`
    origin: Floats  # (3,), world origin of the scenario, meters
    columns: list[str]  # columns of the planned survey
    notes: list[str]


def _read_site(
    area: str,
    drawn: Area | None,
    terrain: Path | None,
    epsg: int | None,
    of_mesh: dict[str, Any],
    terminal: Terminal,
) -> _Site:
    """Read the terrain, and convert the area to the coordinates of the terrain.

    `drawn` is the area as drawn, or None if `area` is the path of a mesh or a scenario.
    """
    import numpy as np

    from lidarscenario.plan.flight_area import GEOGRAPHIC, import_shapely, utm_epsg
    from lidarscenario.plan.flight_lines import Terrain

    shapely = import_shapely()
    if drawn is None and terrain is not None:
        raise click.UsageError(
            f"`--terrain` requires an area in GeoJSON, WKT or bounds, but {area} is a mesh or a "
            "scenario."
        )
    source = Path(area) if drawn is None else terrain
    if source is None:
        assert drawn is not None  # one of both is set
        if of_mesh:
            raise click.UsageError("`--unit` and `--up-axis` require a terrain.")
        if epsg is None and drawn.epsg is not None:
            is_geographic = drawn.epsg == GEOGRAPHIC
            epsg = utm_epsg(drawn.shape) if is_geographic else drawn.epsg
        shape = _in_system(drawn, epsg)
        origin = np.zeros(3)
        if drawn.epsg is not None:
            origin[:2] = np.floor(np.array(shape.centroid.coords[0]) / _ORIGIN_M) * _ORIGIN_M
            shape = shapely.affinity.translate(shape, *(-origin[:2]).tolist())
        return _Site(shape, Terrain(), None, epsg, origin, planned_columns(_FORMATS), [])
    from lidarscenario.scenario import Scenario

    scenario = Scenario.load(source, of_mesh)
    prepared, notes = prepared_with_notes(scenario, terminal)
    scene = prepared.scene.with_world_origin((0, 0, 0))
    origin = np.array(scenario.world.origin, np.float64)
    stated = prepared.survey.epsg
    if epsg is not None and stated not in (None, epsg):
        raise LidarError(
            f"`--epsg` is {epsg}, but the coordinate system of {source} is EPSG:{stated}. Omit "
            "`--epsg`."
        )
    epsg = stated or epsg
    if drawn is None:
        low, high = scene.bounds + scene.origin
        shape = shapely.box(*low[:2].tolist(), *high[:2].tolist())
    else:
        shape = _in_system(drawn, epsg)
        if drawn.epsg is not None:
            shape = shapely.affinity.translate(shape, *(-origin[:2]).tolist())
    return _Site(
        shape,
        Terrain(scene),
        scenario,
        epsg,
        origin,
        planned_columns(_FORMATS, prepared.survey.materials),
        notes,
    )


def _in_system(drawn: Any, epsg: int | None) -> Any:
    """Return the shape of an area in the coordinate system of the plan."""
    from lidarscenario.plan.flight_area import transform_shape

    if drawn.epsg is None:
        return drawn.shape
    if epsg is None:
        raise LidarError(
            f"The area is in EPSG:{drawn.epsg}, but the coordinate system of the terrain is "
            "unknown. Pass its EPSG code with `--epsg`, or draw the area in the coordinates of the "
            "terrain as WKT."
        )
    return transform_shape(drawn.shape, drawn.epsg, epsg)


def _area_name(area: str, drawn: Area | None) -> str:
    """Return a name for the output folder, which is the name of the file or "area"."""
    path = Path(area)
    return (
        path.stem
        if drawn is None or path.suffix in (".geojson", ".json", ".wkt", ".txt")
        else "area"
    )


def _write_plan(
    plan: FlightPlan,
    site: _Site,
    data: dict[str, Any],
    notes: list[str],
    folder: Path,
    terminal: Terminal,
) -> AreaDensity:
    """Write all files of a plan, and return the expected density in the area.

    `data` is the content of the scenario, and `notes` are written to its head.
    """
    from lidarfiles.work.publishing import publishing
    from lidarscenario.plan.flight_density import expected_density, summarize_density
    from lidarscenario.plan.flight_files import to_geojson, to_kml
    from lidarscenario.prepare import prepare
    from lidarscenario.scenario import Scenario

    from ..report.flight_map import draw_flight

    with (
        explain_os_errors(f"The plan cannot be written to {folder}", "free some disk space"),
        publishing(folder / SCENARIO_FILE, remove=() if site.epsg else [KML_FILE]) as staged,
    ):
        (staged / PATH_FILE).write_text(_path_text(plan), "ascii", newline="\n")
        source = "plan" if site.scenario is None else site.scenario.source
        here = data | {
            "trajectory": data["trajectory"] | {"file": str((staged / PATH_FILE).resolve())}
        }
        with terminal.status("estimating the density"):
            prepared = prepare(Scenario.from_data(here, source=source, folder=folder), plans=False)
            scene = prepared.scene.with_world_origin((0, 0, 0))
            area = data["flight"]["area"]
            expected = expected_density(scene, prepared.survey, area)
            density = summarize_density(expected, data["flight"]["density_m2"])
        text = _head(plan, density, notes) + _yaml(data)
        (staged / SCENARIO_FILE).write_text(text, "utf-8", newline="\n")
        geojson = to_geojson(plan, site.epsg, site.origin)
        (staged / GEOJSON_FILE).write_text(geojson, "utf-8", newline="\n")
        if site.epsg is not None:
            kml = to_kml(plan, site.epsg, site.origin)
            (staged / KML_FILE).write_text(kml, "utf-8", newline="\n")
        with terminal.status("drawing the map"):
            draw_flight(plan, expected).save(staged / PICTURE_FILE)
    return density


def _yaml(data: dict[str, Any]) -> str:
    import yaml

    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _plan_sections(plan: FlightPlan, folder: Path) -> dict[str, Any]:
    """Return the sections of the scenario that a plan replaces.

    The scanner has one entry per flight line.
    """
    parts = getattr(plan.area, "geoms", [plan.area])
    rings = [ring for part in parts for ring in (part.exterior, *part.interiors)]
    return {
        "trajectory": {"file": PATH_FILE, "interpolation": "smooth"},
        "sensors": _sensor_sections(plan, folder),
        "flight": {
            "density_m2": round(plan.density_m2 or plan.densities_m2[0], 3),
            "area": [
                [[round(x, 3), round(y, 3)] for x, y, *_ in ring.coords[:-1]] for ring in rings
            ],
        },
    }


def _site_sections(plan: FlightPlan, site: _Site, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the other sections of the scenario, with notes about omitted fields."""
    if site.scenario is None:
        reach_m = plan.layout.agl_m * max(plan.scanner.tangent, plan.scanner.ahead)
        margin_m = max(math.ceil(reach_m * _GROUND_MARGIN), _MIN_MARGIN_M)
        sections: dict[str, Any] = {"scene": {"ground": {"height_m": 0, "margin_m": margin_m}}}
        sections |= {"world": {"origin": site.origin[:2].tolist()}} if site.origin.any() else {}
        sections |= {"cloud": {"columns": site.columns}}
        omissions: list[str] = []
    else:
        sections, omissions = carried_sections(site.scenario, folder, site.columns)
    if site.epsg is not None:
        sections["world"] = sections.get("world", {}) | {"epsg": site.epsg}
    sections["cloud"] = {"precision_m": 0.001} | sections["cloud"]
    return sections, omissions


def _sensor_sections(plan: FlightPlan, folder: Path) -> dict[str, Any]:
    """Return the section `sensors` of the scenario, with an entry for each line."""
    scanner = plan.scanner
    rates = plan.rates
    cycle_rays = rates.fired_hz / rates.scan_hz
    step_deg = _STEP_DEG if cycle_rays <= _STEP_RAYS else 10
    entry: dict[str, Any] = {"model": sensor_entry(scanner.model, folder), "step_deg": step_deg}
    if rates.pulses_per_cycle is not None:
        entry["columns"] = rates.pulses_per_cycle
    if scanner.rates_hz[0] < scanner.rates_hz[1]:
        entry["rate_hz"] = round(rates.scan_hz, 6)
    if scanner.mount.pitch_deg:
        entry["mount"] = {"pitch_deg": scanner.mount.pitch_deg}
    steps_hz = rates.scan_hz * 360 / step_deg
    durations = zip(plan.path.starts_s.tolist(), plan.path.durations_s.tolist(), strict=True)
    return {
        line.name: entry
        | {"start_s": round(start_s, 4), "steps": max(math.ceil(duration_s * steps_hz), 1)}
        for line, (start_s, duration_s) in zip(plan.lines, durations, strict=True)
    }


def _path_text(plan: FlightPlan) -> str:
    """Return the path as a table that `trajectory.file` reads."""
    path = plan.path
    rows = zip(
        path.times_s.tolist(),
        *path.positions.T.tolist(),
        path.yaw_deg.tolist(),
        path.roll_deg.tolist(),
        strict=True,
    )
    lines = ("{:.6f},{:.4f},{:.4f},{:.4f},{:.6f},0,{:.6f}\n".format(*row) for row in rows)
    return "time_s,x,y,z,yaw_deg,pitch_deg,roll_deg\n" + "".join(lines)


def _head(plan: FlightPlan, density: AreaDensity, notes: list[str]) -> str:
    """Return the comments at the beginning of the scenario."""
    summary = " ".join(_summary(plan, density))
    return comment_lines([summary, *(f"Note: {note}." for note in notes)])


def _summary(plan: FlightPlan, density: AreaDensity) -> Iterator[str]:
    """Yield sentences about the lines, the rates and the density."""
    scanner = plan.scanner
    spacing = ""
    if plan.spacing_m is not None:
        subject = ", the lines" if plan.count("cross") else ","
        spacing = f"{subject} {plan.spacing_m:.1f} m apart"
    yield (
        f"{plan.counts}{spacing}, {plan.length_m / 1000:,.2f} km in "
        f"total, {plan.duration_s / 60:.1f} min in the air at {plan.rates.speed_m_s:g} m/s."
    )
    yield (
        f"{scanner.sensor.model}: {format_rounded(plan.rates.fired_hz / 1000)} kHz, "
        f"{plan.rates.scan_hz:g} Hz, a swath of {plan.swath_m:.0f} m at {plan.layout.agl_m:g} m."
    )
    yield (
        f"Expected density: {density.mean_m2:.3g} points per m² on average, at least "
        f"{density.low_m2:.3g} in 95 % of the area."
    )


def _density_notes(plan: FlightPlan, density: AreaDensity) -> Iterator[str]:
    """Yield a note if a part of the area has fewer points than planned."""
    if density.empty > 0:
        remedy = (
            "because it is hidden, or outside the swath over high ground. Increase `--overlap` or "
            "`--agl`, or follow the terrain with `--follow`"
        )
        if plan.has_holes:
            remedy = "above all because the terrain is missing, as noted above"
        if not plan.is_in_range:
            remedy = "because it is out of range or hidden. Change the height first, as noted above"
        yield (
            f"{max(density.empty, 0.001):.1%} of the area has no points in cells of "
            f"{density.cell_m:g} m, {remedy}"
        )
    is_short = (
        plan.has_holes or plan.density_m2 is None or plan.densities_m2[0] < 0.98 * plan.density_m2
    )
    if density.reached < 0.95 and not is_short:
        yield (
            f"{1 - density.reached:.0%} of the area has fewer than {plan.density_m2:g} points per "
            f"m² in cells of {density.cell_m:g} m, because of slopes, or because the points are "
            "not evenly distributed across the swath. 95 % of the area has at least "
            f"{density.low_m2:.3g}. To increase this value, increase `--density` or `--overlap`"
        )


def _lines(plan: FlightPlan, density: AreaDensity, notes: list[str]) -> Iterator[str]:
    """Format a plan as lines of text."""
    yield from _summary(plan, density)
    low, high = plan.densities_m2
    strip = f"{low:.3g}" if high < 1.02 * low else f"{low:.3g} to {high:.3g}"
    target = "" if plan.density_m2 is None else f" (planned: {plan.density_m2:g})"
    yield (
        f"A strip has {strip} points per m²{target}, {plan.along_m:.2f} m apart along the track "
        f"and {plan.across_m:.2f} m across."
    )
    yield "line        start        length    above ground (m)       swath (m)   points per m²"
    for line, start_s in zip(plan.lines[:_SHOWN_LINES], plan.path.starts_s.tolist(), strict=False):
        above = "{:.0f} to {:.0f}".format(*line.clearance_m[::2])
        swath = "{:.0f} to {:.0f}".format(*line.swath_m)
        points = "{:.3g} to {:.3g}".format(*plan.line_density_m2(line))
        yield (
            f"{line.name:<8} {start_s:8,.1f} s {line.leg.length_m:11,.1f} m {above:>19} "
            f"{swath:>15} {points:>15}"
        )
    if (further := len(plan.lines) - _SHOWN_LINES) > 0:
        yield f"{further} further lines"
    yield from map("note: {}".format, notes)


def _figures(
    plan: FlightPlan, site: _Site, density: AreaDensity, notes: list[str]
) -> dict[str, Any]:
    """Return a flight plan as a dictionary for JSON."""
    return {
        "sensor": plan.scanner.sensor.model,
        "speed_m_s": plan.rates.speed_m_s,
        "pulse_rate_hz": plan.rates.fired_hz,
        "scan_rate_hz": plan.rates.scan_hz,
        "swath_m": plan.swath_m,
        "spacing_m": plan.spacing_m,
        "min_overlap": plan.min_overlap,
        "strip_density_m2": list(plan.densities_m2),
        "density": density._asdict(),
        "duration_s": plan.duration_s,
        "length_m": plan.length_m,
        "lines": [
            {
                "name": line.name,
                "start": [*line.leg.start.tolist(), float(line.leg.heights[0])],
                "stop": [*line.leg.stop.tolist(), float(line.leg.heights[-1])],
                "start_s": start_s,
                "clearance_m": list(line.clearance_m),
                "swath_m": list(line.swath_m),
                "density_m2": list(plan.line_density_m2(line)),
            }
            for line, start_s in zip(plan.lines, plan.path.starts_s.tolist(), strict=True)
        ],
        "epsg": site.epsg,
        "world_origin": site.origin.tolist(),
        "notes": notes,
    }
