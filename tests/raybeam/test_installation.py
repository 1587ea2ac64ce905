"""Commands that messages advise install packages where the process runs."""

import pytest

from raybeam import installation
from raybeam.installation import install_command


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 'python -m ensurepip && python -m pip install "a[b]" c'),
        ({"pyvenv.cfg": "home = /usr/bin\nuv = 0.9.1\n"}, 'uv pip install "a[b]" c'),
        ({"conda-meta/history": ""}, 'conda install pip && pip install "a[b]" c'),
    ],
)
def test_environments_without_pip(monkeypatch, tmp_path, files, expected):
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    monkeypatch.setattr(installation.sys, "prefix", str(tmp_path))
    assert install_command("a[b]", "c") == expected


def test_pip_is_used_where_it_is(monkeypatch):
    monkeypatch.setattr(installation, "find_spec", lambda name: "a spec")
    assert install_command("numba") == "pip install numba"
    assert install_command("pye57>=0.4") == 'pip install "pye57>=0.4"'
