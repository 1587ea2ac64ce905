"""Bodies of a world that another program controls, and the frames that carry them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats
from ..numerics.vectors import matmul
from ..scene.files.meshfile import Objects, load_objects
from ..scene.files.scene_graph import NamedFrames, ObjectFrame
from ..scene.object_names import unique_names
from ..scene.scene import Scene
from ..scene.scene_instances import SceneInstance
from ..scene.scene_mesh import SceneMesh
from ..scene.transform import affine, inverse_pose

WORLD = ""  # name of the world frame in `WorldFrame.parent`


class WorldFrame(NamedTuple):
    """Frame whose pose a program can control, at its pose in the file."""

    parent: str  # name of the parent frame; `WORLD` for the world
    matrix: Floats  # (4, 4), from the frame to its parent


@dataclass(frozen=True, eq=False)
class WorldBody:
    """A rigid body that is carried by a frame.

    Attributes
    ----------
    item
        Mesh or instance in world coordinates, at its pose in the file. It has the name of the body.
    frame
        Name of the frame that carries the body.
    matrix
        Transform from the frame to the world, at its pose in the file. Shape (4, 4).
    is_static
        Whether the file states that the body never moves, or None if it does not state it.
    """

    item: SceneMesh | SceneInstance
    frame: str
    matrix: Floats
    is_static: bool | None = None

    @property
    def name(self) -> str:
        """Name of the body, which is unique in its world."""
        return self.item.name

    @property
    def can_move(self) -> bool:
        """Whether the body can be an actor. Voxels cannot move."""
        mesh = self.item.mesh if isinstance(self.item, SceneInstance) else self.item
        return mesh.voxels is None

    def mesh(self) -> SceneMesh:
        """Return the mesh in the frame that carries the body."""
        back = inverse_pose(self.matrix)
        mesh = self.item
        if isinstance(mesh, SceneInstance):
            back = matmul(back, mesh.matrix)
            mesh = mesh.mesh
        return mesh.affine_transform(self.name, back[:3, :3], back[:3, 3])


@dataclass(frozen=True, eq=False)
class World:
    """Bodies and frames of a world.

    Attributes
    ----------
    bodies
        Bodies with unique names.
    frames
        Frames by name. The frames of the bodies and the frames that carry them are included.
    static
        Scene to which the bodies are added. If None, bodies are static until they move.
    roots
        Names of frames that coincide with the world frame.
    ambiguous
        Names that the file uses for several frames. These frames cannot be controlled.
    """

    bodies: tuple[WorldBody, ...]
    frames: Mapping[str, WorldFrame]
    static: Scene | None = None
    roots: frozenset[str] = frozenset()
    ambiguous: frozenset[str] = frozenset()

    @classmethod
    def load(cls, path: str | Path, **options: Any) -> World:
        """Read the objects of a scene file as bodies.

        Objects that move in the file are bodies at their first poses.

        Parameters
        ----------
        path
            Path of a file that `Scene.load` reads.
        **options
            Options of `Scene.load`.

        Raises
        ------
        LidarError
            If the file cannot be read.
        """
        return cls.from_objects(load_objects(path, **options))

    @classmethod
    def from_objects(cls, objects: Objects) -> World:
        """Convert the objects of a file to bodies."""
        items = list(objects.static)
        frames = [ObjectFrame(np.eye(4)) for _ in items]
        empty: Sequence[NamedFrames] = ()
        if objects.frames is not None:
            frames = objects.frames.in_world()
            empty = objects.frames.empty_in_world()
        for actor in objects.actors:
            positions, rotations = actor.trajectory.poses(0, np.zeros(1))
            matrix = affine(np.eye(3) if rotations is None else rotations[0], positions[0])
            frames.append(ObjectFrame(matrix, is_static=False))
            items.append(SceneInstance(actor.mesh, matrix, actor.name))
        names = unique_names([item.name for item in items])
        named = [
            item if item.name == name else replace(item, name=name)
            for item, name in zip(items, names, strict=True)
        ]
        chains: list[NamedFrames] = []
        bodies = []
        for item, frame in zip(named, frames, strict=True):
            chain = frame.enclosing
            if item.name not in dict(chain):  # a format can name an object after an outer frame
                chain = (*chain, (item.name, frame.matrix))
            chains.append(chain)
            bodies.append(WorldBody(item, *chain[-1], frame.is_static))
        world = cls._from_chains(bodies, [*chains, *empty])
        root = "" if objects.frames is None else objects.frames.root
        return replace(world, roots=frozenset({root} - {""}))

    @classmethod
    def _from_chains(cls, bodies: Sequence[WorldBody], chains: Sequence[NamedFrames]) -> World:
        """Create a world, given chains of frames in world coordinates."""
        in_world: dict[str, tuple[str, Floats]] = {}  # {frame: its parent and its matrix}
        ambiguous = set()
        for chain in chains:
            parent = WORLD
            for name, matrix in chain:
                known = in_world.setdefault(name, (parent, matrix))
                if known[0] != parent or not np.array_equal(known[1], matrix):
                    ambiguous.add(name)
                parent = name
        bodies = [_with_own_frame(body, ambiguous, in_world) for body in bodies]
        matrices = {name: matrix for name, (_, matrix) in in_world.items()} | {WORLD: np.eye(4)}
        relative = {}
        for name, (parent, matrix) in in_world.items():
            while parent in ambiguous:
                parent = in_world[parent][0]
            relative[name] = WorldFrame(parent, matmul(inverse_pose(matrices[parent]), matrix))
        known_frames = {name: frame for name, frame in relative.items() if name not in ambiguous}
        return cls(tuple(bodies), known_frames, ambiguous=frozenset(ambiguous))

    def renamed(self, model: str, copy: str) -> World:
        """Return the world with the frame `model`, and all frames and bodies in it, renamed.

        For example, `crate/link` becomes `crate_2/link` if `crate` is renamed to `crate_2`.
        """

        def rename(name: str) -> str:
            inside = name == model or name.startswith(f"{model}/")
            return copy + name[len(model) :] if inside else name

        bodies = tuple(
            replace(body, item=replace(body.item, name=rename(body.name)), frame=rename(body.frame))
            for body in self.bodies
        )
        frames = {
            rename(name): WorldFrame(rename(frame.parent), frame.matrix)
            for name, frame in self.frames.items()
        }
        return replace(self, bodies=bodies, frames=frames)

    def with_world(self, other: World) -> World:
        """Return a world that also has the bodies and frames of another world.

        Raises
        ------
        LidarError
            If both worlds have a body with the same name.
        """
        names = {body.name for body in self.bodies}
        if doubles := [body.name for body in other.bodies if body.name in names]:
            raise LidarError(f"The world already has a body {doubles[0]!r}. Rename one of them.")
        return replace(
            self,
            bodies=(*self.bodies, *other.bodies),
            frames={**self.frames, **other.frames},
            ambiguous=self.ambiguous | other.ambiguous,
        )

    def without_bodies(self, names: Iterable[str]) -> World:
        """Return a world that lacks some bodies. Their frames are kept."""
        removed = set(names)
        return replace(self, bodies=tuple(body for body in self.bodies if body.name not in removed))

    def chain(self, frame: str) -> tuple[str, ...]:
        """Return the frames from a frame to the world in the file, without the world."""
        names = []
        while frame in self.frames and frame not in names:
            names.append(frame)
            frame = self.frames[frame].parent
        return tuple(names)


def _with_own_frame(
    body: WorldBody, ambiguous: set[str], in_world: Mapping[str, tuple[str, Floats]]
) -> WorldBody:
    """Return a body whose frame has a unique name, which is that of a carrier if necessary."""
    frame = body.frame
    matrix = body.matrix
    while frame in ambiguous:
        frame = in_world[frame][0]
        matrix = np.eye(4) if frame == WORLD else in_world[frame][1]
    return replace(body, frame=frame, matrix=matrix)
