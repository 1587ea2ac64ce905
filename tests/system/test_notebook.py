"""The notebook among the examples, executed as a user would."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLE = Path(__file__).parents[2] / "examples/drive.ipynb"


@pytest.mark.slow
def test_the_notebook_of_augmentation_runs(tmp_path):
    notebook = nbformat.read(EXAMPLE.with_name("augment.ipynb"), 4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert not [output for output in shown if output.output_type == "error"]
    lines = "".join(o.text for o in shown if o.output_type == "stream").splitlines()
    from_snow = [int(line.split()[3]) for line in lines if "from snow" in line]
    assert len(from_snow) == 5 and min(from_snow) > 2000
    assert any("image/png" in output.data for output in shown if "data" in output)


@pytest.mark.slow
def test_the_notebook_shows_progress_a_result_a_table_and_a_picture(tmp_path):
    notebook = nbformat.read(EXAMPLE, 4)
    assert not any(cell.get("outputs") for cell in notebook.cells)  # they would grow old
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert not [output for output in shown if output.output_type == "error"]
    kinds = [set(output.data) for output in shown if "data" in output]
    assert any("application/vnd.jupyter.widget-view+json" in kind for kind in kinds)  # bars
    assert any("image/png" in kind for kind in kinds)
    result = next(
        o.data["text/html"] for o in shown if "survey" in o.get("data", {}).get("text/html", "")
    )
    assert "180 scans (5 sweeps), 144,688 rays" in result
    assert result.count("data:image/png;base64") == 2
    assert result.count("max-width:800px") == 2  # as drawn: smaller, letters could not be read
    assert "<iframe src=" in shown[-1].data["text/html"]
    html = [output.data.get("text/html", "") for output in shown if "data" in output]
    assert any("sweeps of Velodyne VLP-16" in text and "<iframe" in text for text in html)
    assert any("<caption>" in text and "data:image/png" in text for text in html)  # of a cloud
