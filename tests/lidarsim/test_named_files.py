"""Names of files in data lead to files of the data only."""

import pytest

from lidarsim import LidarError
from lidarsim.io.named_files import file_below, is_inside, is_plain
from lidarsim.io.storage import Storage
from lidarsim.scene.files.meshfile import load_meshes


@pytest.fixture
def root(tmp_path):
    """A folder of data, beside which is a file, with links to that file and to its folder."""
    folder = tmp_path / "data"
    (folder / "sweeps").mkdir(parents=True)
    (folder / "sweeps" / "a.bin").write_text("a")
    (tmp_path / "secret.bin").write_text("secret")
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    (folder / "sweeps" / "above").symlink_to(tmp_path)
    (folder / "inner").symlink_to(folder / "sweeps")
    return folder


@pytest.mark.parametrize("name", ["sweeps/a.bin", "./sweeps/a.bin", "inner/a.bin", "sweeps/gone"])
def test_names_below_the_root_are_files_of_the_data(root, name):
    assert file_below(root, name, "list.txt") == root / name


@pytest.mark.parametrize("name", [
    "../secret.bin", "sweeps/../../secret.bin", "sweeps/../sweeps/a.bin", "link.bin",
    "sweeps/above/secret.bin", "{root}/sweeps/a.bin", "/etc/hostname",
])  # fmt: skip
def test_names_that_lead_outside_are_refused(root, name):
    name = name.format(root=root)
    with pytest.raises(LidarError) as told:
        file_below(root, name, "list.txt, line 7,")
    assert str(told.value).startswith(f"list.txt, line 7, refers to {name!r}, which is outside")
    assert len(str(told.value).splitlines()) == 1


def test_a_root_may_be_a_link_itself(root, tmp_path):
    (tmp_path / "disk").symlink_to(root)
    path = file_below(tmp_path / "disk", "sweeps/a.bin", "list.txt")
    assert path.read_text() == "a" and is_inside(path, [root])


def test_a_folder_in_the_root_may_be_on_another_disk(root, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "b.bin").write_text("b")
    (root / "samples").symlink_to(tmp_path / "disk")
    assert file_below(root, "samples/b.bin", "list.txt").read_text() == "b"


@pytest.mark.parametrize(("name", "plain"), [
    ("0417", True), ("a.b", True), ("..a", True), ("", False), (".", False), ("..", False),
    ("a/b", False), ("/a", False), ("a\\b", False), ("a\0", False),
])  # fmt: skip
def test_plain_names_have_no_folders(name, plain):
    assert is_plain(name) is plain


@pytest.mark.parametrize("name", ["../secret.bin", "sweeps/../../secret.bin", "/etc/hostname"])
def test_a_storage_uses_files_of_its_folder_only(root, name):
    for storage in (Storage.at(root), Storage(str(root))):
        for use in (storage.read, storage.checksum, storage.below, storage.prepare):
            with pytest.raises(LidarError, match="is not the name of a file in"):
                use(name)
        with pytest.raises(LidarError, match="is not the name of a file in"):
            storage.copy_from(storage, name, "taken")
        assert storage.read("sweeps/a.bin") == b"a"


@pytest.mark.parametrize("name", ["../m.mtl", "/{root}/m.mtl", "link.mtl"])
def test_materials_outside_are_noted_with_what_to_name(tmp_path, name):
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "m.mtl").write_text("newmtl A\nKd 1 0 0\n")
    (folder / "link.mtl").symlink_to(tmp_path / "m.mtl")
    name = name.format(root=tmp_path)
    (folder / "a.obj").write_text(f"mtllib {name}\nusemtl A\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    notes = []
    (mesh,) = load_meshes(folder / "a.obj", colors=True, report=notes.append)
    assert mesh.colors is None
    assert f"{name} (outside the folder of the mesh; set assets to" in notes[0]
    (mesh,) = load_meshes(folder / "a.obj", colors=True, assets=tmp_path, report=notes.append)
    assert mesh.colors is not None and len(notes) == 1
