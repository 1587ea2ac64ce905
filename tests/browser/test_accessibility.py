"""Our own pages as axe-core judges them, at three widths, light and dark."""

import json
import shutil
import subprocess
import tarfile

import pytest

pytestmark = [pytest.mark.browser, pytest.mark.slow]

AXE = "4.14.1"
WIDTHS = (420, 1280, 1920)
# Whatever is hidden at first is shown: the keys' list has a look of its own.
SHOW_ALL = """(() => {
  for (const part of document.querySelectorAll('details')) part.open = true;
  document.documentElement.classList.remove('no-panel');
})()"""
FAULTS = """axe.run(document, { resultTypes: ['violations'], iframes: false }).then((told) => {
  const faults = told.violations.filter(({ impact }) => ['serious', 'critical'].includes(impact));
  const words = ({ html, failureSummary }) => `${html.slice(0, 160)}: ${failureSummary}`;
  return JSON.stringify(faults.map(({ id, nodes }) => [id, nodes.map(words)]));
})"""


@pytest.fixture(scope="session")
def axe(request):
    """Return axe-core's script, from npm; only this test uses it."""
    folder = request.config.cache.mkdir("axe-core")
    file = folder / f"axe-core-{AXE}.tgz"
    if not file.exists():
        if shutil.which("npm") is None:
            pytest.skip("needs npm, which brings axe-core")
        pack = ["npm", "pack", "--silent", f"axe-core@{AXE}"]
        packed = subprocess.run(pack, cwd=folder, capture_output=True, text=True, timeout=120)
        if packed.returncode:
            pytest.skip(f"npm brings no axe-core: {packed.stderr.strip()[-200:]}")
    with tarfile.open(file) as archive:
        return archive.extractfile("package/axe.min.js").read().decode()


def ready(tab):
    """Wait until a page shows its points or its jobs."""
    tab.wait_for(lambda text: " points" in text or "jobs done" in text)
    tab.wait_for(lambda _: tab.value("document.readyState === 'complete'"))


@pytest.mark.parametrize(
    "page", ["result", "jobs", "live", "campaign", "job in a frame", "exported"]
)
def test_axe_finds_no_serious_fault(axe, own_pages, new_tab, page):
    tab = new_tab("about:blank")
    tab.open(own_pages[page])
    ready(tab)
    tab.value(axe + "; 0")
    faults = {}
    for width in WIDTHS:
        for scheme in ("light", "dark"):
            tab.resize(width)
            tab.prefer(scheme)
            tab.wait_for(
                lambda _, scheme=scheme: (
                    tab.value("document.documentElement.dataset.theme") == scheme
                )
            )
            if page != "job in a frame":
                tab.value(SHOW_ALL)
            for fault, nodes in json.loads(tab.value(FAULTS)):
                faults.setdefault(fault, {}).update(dict.fromkeys(nodes, (width, scheme)))
    assert not faults, json.dumps(faults, indent=1)


def test_axe_finds_no_serious_fault_in_what_opens_on_demand(axe, own_pages, new_tab):
    """The list of keys, a measurement, the clip box's handles and the range image."""
    tab = new_tab("about:blank")
    tab.resize(1280)
    tab.open(f"{own_pages['result']}#measure=distance;0,0,0;1,1,1&box=true&images=true")
    ready(tab)
    tab.value(axe + "; 0")
    for scheme in ("light", "dark"):
        tab.prefer(scheme)
        assert json.loads(tab.value(FAULTS)) == []
        tab.key("?")
        assert json.loads(tab.value(FAULTS)) == []
        tab.key("?")
