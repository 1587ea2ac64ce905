"""The `lidarpool follow` command, which simulates sensors next to a running simulator."""

from __future__ import annotations

from pathlib import Path

import click

from lidarfiles.clouds.built_in_formats import LAYOUTS

from . import shared_options as options
from .first_step import print_first_step


@click.command()
@click.argument("world", metavar="WORLD", type=click.Path(path_type=Path))
@options.path(
    "--sensors",
    "sensors_file",
    help="Sensors on frames of the world, as a .yaml file (default: the sensors of the scenario).",
)
@click.option(
    "--as",
    "bridge_name",
    type=click.Choice(["ros2"]),
    required=True,
    help="Protocol of the simulator and of the sensors: ros2 (ROS 2 topics).",
)
@click.option(
    "--to",
    metavar="ADDRESS",
    multiple=True,
    help="Address of the simulator and of the subscribers, if they are not on this machine "
    "(default: 127.0.0.1).",
)
@click.option(
    "--layout",
    type=click.Choice(list(LAYOUTS)),
    default="velodyne",
    show_default=True,
    help="Point layout.",
)
@click.option(
    "--organized",
    is_flag=True,
    help="Publish one point per ray, with NaN for rays without a return.",
)
@click.option(
    "--models",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Folder of the models that the simulator can spawn.",
)
@click.option(
    "--assets",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="FOLDER",
    help="Additional folder with files that WORLD uses.",
)
@click.option(
    "--world-frame",
    "world_frames",
    metavar="NAME",
    multiple=True,
    help="Frame that coincides with the world, in addition to world, map, and the name of a Gazebo "
    "world; can be repeated.",
)
@click.option(
    "--vanish-after",
    "vanish_after_s",
    type=options.Number(0, 1e6),
    default=1.0,
    show_default=True,
    metavar="SECONDS",
    help="Simulation time without poses after which a model is removed; 0 keeps all models.",
)
def follow(
    *,
    world: Path,
    sensors_file: Path | None,
    bridge_name: str,
    to: tuple[str, ...],
    layout: str,
    organized: bool,
    models: Path | None,
    assets: Path | None,
    world_frames: tuple[str, ...],
    vanish_after_s: float,
) -> None:
    """Simulate sensors in the world of a simulator that is running.

    WORLD is the file that the simulator has loaded: a Gazebo world, a MuJoCo model, a robot
    (.urdf), a scene such as .glb or .usd, or a scenario. The command receives the time and the
    poses of the objects, and publishes the sweeps of the sensors in simulation time until Ctrl-C is
    pressed.

    \b
    Examples:
      lidarpool follow house.sdf --sensors sensors.yaml --as ros2
      lidarpool follow house.sdf --sensors sensors.yaml --as ros2 --models models --layout ouster
      lidarpool follow robot.urdf --sensors sensors.yaml --as ros2 --world-frame odom
    """  # noqa: D301 - Click requires the character \b
    print_first_step("reading the world")
    from lidarlive.playback.bridge import bridge_class

    bridge_class(bridge_name)  # raises an error if its packages are not installed
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarlive.following.node import FollowOptions
    from lidarlive.following.opening import FollowSources, create_node
    from lidarlive.following.pose_input import is_wanted
    from lidarlive.playback.dds import Network, RosPublisher, RosSubscriber

    from .terminal import Terminal

    keep_freed_memory()
    report = Terminal().report
    sources = FollowSources(world, sensors_file, models, assets, layout, organized)
    follow_options = FollowOptions(("world", "map", *world_frames), vanish_after_s)
    network = Network.for_hosts(to)
    with RosPublisher(network) as publisher:
        connections = publisher, RosSubscriber(publisher, is_wanted, report)
        node = create_node(sources, connections, follow_options, report)
        with options.summary_at_end(lambda: node.summary):
            node.start()
            click.echo(
                f"ready: {node.description} in ROS 2 domain {network.domain} on {network.address}. "
                "Press Ctrl-C to stop."
            )
            node.run()
