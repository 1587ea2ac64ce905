"""Instances against the same triangles in one mesh, and the backends against each other."""

import numpy as np
import pytest

from raybeam import Instance, Mesh, Pattern, RayCaster, available_backends

FIELDS = ("distance", "triangle", "u", "v", "instance")


def shift(x, y, z):
    return np.column_stack([np.eye(3), [x, y, z]])


def transforms(rng, count, kind):
    """Matrices (count, 3, 4) that turn, move by some 10 m, and do what `kind` says."""
    turns = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]  # half of them mirror
    scales = {
        "turned": np.ones((count, 3)),
        "uneven": rng.uniform(0.3, 3, (count, 3)),
        "mirrored": rng.choice([-1.0, 1.0], (count, 3)),
    }
    if kind == "sheared":
        turns = turns @ (np.eye(3) + 0.5 * rng.normal(size=(count, 3, 3)))
    else:
        turns = turns * scales[kind][:, None]
    return np.concatenate([turns, rng.uniform(-10, 10, (count, 3, 1))], axis=2)


def flattened(meshes, numbers, matrices):
    """All instances as one mesh; and of each face, its instance and its row there."""
    vertices = []
    faces = []
    instance = []
    row = []
    start = 0
    for number, (mesh, matrix) in enumerate(zip(numbers, matrices, strict=True)):
        points, triangles = meshes[mesh]
        vertices.append(points @ matrix[:, :3].T + matrix[:, 3])
        faces.append(triangles + start)
        start += len(points)
        instance.append(np.full(len(triangles), number))
        row.append(np.arange(len(triangles)))
    return map(np.concatenate, (vertices, faces, instance, row))


def rays(rng, count, reach=15.0):
    origins = rng.uniform(-reach, reach, (count, 3))
    return origins, rng.uniform(-reach / 2, reach / 2, (count, 3)) - origins


@pytest.fixture
def forest(shapes):
    """Two meshes in 40 places: instances, their meshes, numbers and matrices."""

    def make(kind, seed=0, offset=0.0):
        rng = np.random.default_rng(seed)
        meshes = [shapes["vase"](20, 20), shapes["terrain box"](8)]
        numbers = rng.integers(2, size=40)
        matrices = transforms(rng, 40, kind) + np.array([0, 0, 0, offset])
        given = [Mesh(*mesh) for mesh in meshes]
        instances = [
            Instance(given[k], matrix) for k, matrix in zip(numbers, matrices, strict=True)
        ]
        return instances, meshes, numbers, matrices

    return make


def same(one, other):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.extended
@pytest.mark.slow(every=5)
@pytest.mark.parametrize("offset", [0.0, 5e5])
@pytest.mark.parametrize("kind", ["turned", "mirrored", "uneven", "sheared"])
def test_as_the_same_triangles_in_one_mesh(backend, forest, kind, offset):
    instances, meshes, numbers, matrices = forest(kind, offset=offset)
    vertices, faces, instance, row = flattened(meshes, numbers, matrices)
    origins, directions = rays(np.random.default_rng(1), 5_000)
    got = RayCaster.from_instances(instances, backend).cast(origins + offset, directions)
    want = RayCaster(vertices, faces, backend).cast(origins + offset, directions)
    assert 0.3 < want.hit.mean() < 0.95
    assert np.array_equal(got.hit, want.hit)
    both = got.hit & want.hit
    # Where two surfaces cross, either may be the closer one by rounding.
    np.testing.assert_allclose(got.distance[both], want.distance[both], rtol=0, atol=1e-5)
    seen = both & (got.instance == instance[want.triangle])
    seen &= got.triangle == row[want.triangle]
    assert (both & ~seen).sum() <= 5
    assert (got.instance[~got.hit] == -1).all()
    np.testing.assert_allclose(got.u[seen], want.u[seen], atol=1e-4)


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["turned", "uneven", "sheared"])
def test_kernels_have_the_bits_of_numpy(kernels, forest, kind):
    instances, *_ = forest(kind, 2)
    origins, directions = rays(np.random.default_rng(3), 5_000, 30.0)
    numpy, other = (RayCaster.from_instances(instances, name) for name in ("numpy", kernels))
    for limits in ((0, np.inf), (4, 9)):
        want = numpy.cast(origins, directions, *limits)
        assert want.hit.sum() > 50
        same(other.cast(origins, directions, *limits), want)


def test_tiles_have_the_bits_of_numpy(forest):
    if reason := available_backends()["tiles"]:
        pytest.skip(f"tiles: {reason}")
    instances, *_ = forest("sheared", 4)
    origins, directions = rays(np.random.default_rng(5), 100_000)
    want = RayCaster.from_instances(instances, "numpy").cast(origins, directions)
    got = RayCaster.from_instances(instances, "tiles").cast(origins, directions)
    differ = np.any([getattr(got, name) != getattr(want, name) for name in FIELDS], axis=0)
    assert not differ.any()


@pytest.mark.extended
def test_scans_and_tallies_of_many_instances(backend, shapes):
    """2,000 instances of two meshes, cast as a scan and ray by ray."""
    rng = np.random.default_rng(6)
    small = shapes["cube"]()
    first = shapes["sphere"](8, 12)
    meshes = [Mesh(*small), Mesh(*first), Mesh(*small)]
    numbers = rng.integers(1, 3, 2_000)
    numbers[0] = 2
    matrices = transforms(rng, 2_000, "uneven") * [1, 1, 1, 5]
    instances = [Instance(meshes[k], m) for k, m in zip(numbers, matrices, strict=True)]
    caster = RayCaster.from_instances(instances, backend, threads=1)
    assert (caster.instance_count, caster.face_count) == (2_000, 12 + len(first[1]))
    directions = rng.normal(size=(3_000, 3))
    hits = caster.cast([0, 0, 0], directions)
    scan = caster.scan(Pattern(directions), [0, 0, 0], keep_every=3, tally=True)
    ray = np.flatnonzero(hits.hit)
    assert scan.hit_counts.tolist() == [len(ray)]
    assert len(ray) > 2_000
    for name in ("distance", "triangle", "instance"):
        np.testing.assert_array_equal(getattr(scan, name), getattr(hits, name)[ray[::3]])
    # The cube is used first, so its rows come first.
    rows = hits.triangle[ray] + np.where(numbers[hits.instance[ray]] == 1, 12, 0)
    np.testing.assert_array_equal(scan.tally, np.bincount(rows, minlength=caster.face_count))


def test_ties_go_to_the_lowest_instance_and_then_to_the_lowest_triangle(backend):
    square = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    one = Mesh(square, [[0, 1, 2], [0, 2, 3]])
    other = Mesh(square, [[0, 2, 3], [0, 1, 2], [0, 2, 3]])
    upside_down = np.diag([1.0, -1, -1])
    places = [shift(0, 0, -1), shift(0, 0, 2), np.column_stack([upside_down, [0, 0, 2]])]
    origins = np.array([[0.5, -0.25, 4], [-0.5, 0.25, 4], [0.5, 0.25, 4]])
    down = np.broadcast_to([0, 0, -1.0], (3, 3))
    for meshes in ((one, one, other), (one, other, one), (other, other, other)):
        instances = [Instance(m, p) for m, p in zip(meshes, places, strict=True)]
        hits = RayCaster.from_instances(instances, backend).cast(origins, down)
        assert hits.distance.tolist() == [2, 2, 2]
        assert hits.instance.tolist() == [1, 1, 1]
        in_one = [0, 1, 0] if meshes[1] is one else [1, 0, 1]
        assert hits.triangle.tolist() == in_one
        swapped = RayCaster.from_instances([instances[0], *instances[:0:-1]], backend).cast(
            origins, down
        )
        assert swapped.instance.tolist() == [1, 1, 1]


def test_moved_instances_are_found_where_a_new_caster_finds_them(backend, forest):
    instances, *_ = forest("uneven", 8)
    caster = RayCaster.from_instances(instances, backend)
    origins, directions = rays(np.random.default_rng(9), 3_000, 30.0)
    before = caster.cast(origins, directions)
    # The last one goes far away, so the scene's coordinates change.
    for number, place in ((3, shift(1, 2, 3)), (7, np.eye(4)), (0, shift(90, 50, -40))):
        caster.set_transforms(number, place)
        instances[number] = Instance(instances[number].mesh, place)
    after = caster.cast(origins, directions)
    assert (after.instance != before.instance).any()
    same(after, RayCaster.from_instances(instances, backend).cast(origins, directions))
    together = RayCaster.from_instances(forest("uneven", 8)[0], backend)
    together.set_transforms(
        [3, 7, 0], np.stack([shift(1, 2, 3), np.eye(4)[:3], shift(90, 50, -40)])
    )
    same(together.cast(origins, directions), after)
    with pytest.raises(IndexError, match="Instance 41"):
        caster.set_transforms([2, 41], [np.eye(4)] * 2)
    with pytest.raises(ValueError, match="instance 6 is singular"):
        caster.set_transforms([2, 6], [np.eye(4), np.diag([1, 1, 0, 1])])
    with pytest.raises(ValueError, match="2 instances require transforms"):
        caster.set_transforms([2, 6], np.eye(4)[None])
    with pytest.raises(IndexError, match="Instance 40"):
        caster.set_transforms(40, np.eye(4))
    with pytest.raises(ValueError, match="instance 5 is singular"):
        caster.set_transforms(5, np.zeros((3, 4)))
    same(caster.cast(origins, directions), after)


@pytest.mark.extended
def test_closed_meshes_do_not_leak(backend, shapes):
    """Rays from inside an instance at the corners and edges of its mesh."""
    rng = np.random.default_rng(10)
    vertices, faces = shapes["vase"](24, 24)
    matrices = transforms(rng, 3, "sheared")
    caster = RayCaster.from_instances(
        [Instance(Mesh(vertices, faces), m) for m in matrices], backend
    )
    ends = vertices[faces[rng.integers(len(faces), size=3_000)][:, :2]]
    part = np.clip(rng.uniform(-0.5, 1.5, (3_000, 1)), 0, 1)
    for number, matrix in enumerate(matrices):
        inside = matrix[:, :3] @ [0.05, 0.1, 0.4] + matrix[:, 3]
        targets = (ends[:, 0] * part + ends[:, 1] * (1 - part)) @ matrix[:, :3].T + matrix[:, 3]
        alone = RayCaster.from_instances([Instance(Mesh(vertices, faces), matrix)], backend)
        assert alone.cast(inside, targets - inside).hit.all()
        assert caster.cast(inside, targets - inside).hit.all(), number


def test_an_instance_without_a_transform_is_its_mesh(backend, shapes):
    mesh = shapes["vase"](20, 20)
    origins, directions = rays(np.random.default_rng(11), 2_000, 4.0)
    plain = RayCaster(*mesh, backend)
    alone = RayCaster.from_instances([Instance(Mesh(*mesh))], backend)
    want = plain.cast(origins, directions)
    same(alone.cast(origins, directions), want)
    assert (want.instance == np.where(want.hit, 0, -1)).all()
    with pytest.raises(ValueError, match="cannot be moved"):
        alone.set_transforms(0, np.eye(4))


@pytest.mark.extended
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_meshes_much_smaller_and_larger_than_the_scene(backend, shapes, scale):
    """The scene is 1 km across; a ray's answer depends on the mesh that it meets."""
    vertices, faces = shapes["sphere"](12, 18)
    place = np.column_stack([np.eye(3) * 0.5 / scale, [400, 300, 2]])
    far = Instance(Mesh(*shapes["cube"]()), shift(-500, -500, 0))
    caster = RayCaster.from_instances(
        [far, Instance(Mesh(vertices * scale, faces), place)], backend
    )
    rng = np.random.default_rng(12)
    targets = rng.normal(size=(500, 3))
    targets = 0.4 * targets / np.linalg.norm(targets, axis=1, keepdims=True)
    origins = rng.uniform(-5, 5, (500, 3))
    want = RayCaster(vertices * 0.5, faces, backend).cast(origins, targets - origins)
    middle = [400, 300, 2]
    got = caster.cast(origins + middle, targets - origins)
    np.testing.assert_array_equal(got.triangle, want.triangle)
    np.testing.assert_allclose(got.distance, want.distance, rtol=1e-9)


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        (np.eye(3), r"instance 1 must be .*\(3, 3\)"),
        (np.eye(4).astype(complex), "instance 1 must be .*complex"),
        (np.diag([1.0, 1, 1, 2]), "last row of the transform of instance 1"),
        (np.full((3, 4), np.nan), "instance 1 must be finite"),
        (np.diag([1.0, 1, 0, 1]), "instance 1 is singular"),
        (np.arange(12).reshape(3, 4), "instance 1 is singular"),
        (1e200 * np.eye(3, 4), "instance 1 is singular"),
    ],
)
def test_refused(transform, words):
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    with pytest.raises(ValueError, match=words):
        RayCaster.from_instances([Instance(mesh), Instance(mesh, transform)], "numpy")
    with pytest.raises(ValueError, match="at least one"):
        RayCaster.from_instances([], "numpy")
