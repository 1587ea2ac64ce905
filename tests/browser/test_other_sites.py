"""Websites that a browser has open cannot use it against sensors and pages of its user."""

import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from tests.spirals import WET, spiral, spiral_view

from lidarlive.devices.services import service_of
from lidarsim import load_sensor
from lidarsim.packets.encoders import PacketSource, encoder_of
from lidarsim.packets.service import Destination
from lidarview.viewer.server import page_server

pytestmark = [pytest.mark.browser, pytest.mark.slow]

# Sends requests in all ways in which a page can, and has the title «done» after the last.
HOSTILE = """<!doctype html><title>busy</title><body><a href="%(link)s">link</a><script>
const urls = %(urls)s;
const settled = (element, url) => new Promise((done) => {
  element.onload = element.onerror = done;
  element.src = url;
  document.body.append(element);
});
const image = (url, referrerPolicy) => settled(Object.assign(new Image(), { referrerPolicy }), url);
const frame = (url) => settled(document.createElement("iframe"), url);
const form = (url) => {
  const target = document.createElement("iframe"), form = document.createElement("form");
  target.name = `frame${frames.length}`;
  Object.assign(form, { method: "POST", action: url, target: target.name });
  document.body.append(target, form);
  const sent = new Promise((done) => { target.onload = done; });
  form.submit();
  return sent;
};
const nothing = () => {};
const post = (url) =>
  fetch(url, { method: "POST", mode: "no-cors", body: "addr=127.0.0.77" }).catch(nothing);
(async () => {
  for (const url of urls) {
    await image(url, "");
    await image(url, "no-referrer");
    await settled(document.createElement("script"), url);
    await post(url);
    await frame(url);
    await form(url);
  }
  document.title = "done";
})();
</script>"""


@contextmanager
def website(urls, link="about:blank"):
    """Serve a hostile page, and yield its port."""
    content = (HOSTILE % {"urls": list(urls), "link": link}).encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


@contextmanager
def live_sensor(model):
    """Yield the port of a sensor's interface, and the destinations that it asks for."""
    encoder = encoder_of(PacketSource(load_sensor(model), "strongest", "roof"))
    asked = []
    destination = Destination("127.0.0.1", {port: port for port in encoder.ports.values()})
    with service_of(encoder, "127.0.0.1:0", destination, asked.append) as service:
        yield service.port, asked


SET = "api/v1/sensor/cmd/set_config_param?args=udp_dest+127.0.0.77"
START = "api/v1/sensor/cmd/reinitialize"


def wait_for_requests(tab, kind):
    """Wait until a hostile page has sent its requests."""
    tab.wait_for(lambda _: tab.value("document.title") == "done")
    assert any(kind in url for url in tab.requests)


# Names stand for loopback in the tests' browser. It sends Sec-Fetch-Site to 127.0.0.1 alone.
@pytest.mark.parametrize("site", ["localhost", "site.example"])
@pytest.mark.parametrize("sensor", ["127.0.0.1", "203.0.113.50"])
def test_a_website_does_not_redirect_a_sensor(new_tab, site, sensor):
    with live_sensor("ouster/os0-32") as (ouster, asked), live_sensor("velodyne/vlp16") as other:
        velodyne, asked_of_velodyne = other
        urls = [f"http://{sensor}:{ouster}/{path}" for path in (SET, START, "api/v1/sensor/config")]
        urls.append(f"http://{sensor}:{velodyne}/cgi/setting/host")
        with website(urls) as port:
            tab = new_tab(f"http://{site}:{port}/")
            wait_for_requests(tab, "/cgi/setting/host")
    assert asked == asked_of_velodyne == []


def test_a_name_that_is_resolved_to_the_sensor_is_refused(new_tab):
    with live_sensor("ouster/os0-32") as (port, asked):
        tab = new_tab("about:blank")
        for path in (SET, START):
            tab.open(f"http://site.example:{port}/{path}")
            tab.wait_for(lambda text: "'site.example:" in text and "not a name" in text)
    assert asked == []


def test_the_user_configures_a_sensor_in_a_browser(new_tab):
    with live_sensor("ouster/os0-32") as (port, asked):
        tab = new_tab(f"http://127.0.0.1:{port}/{SET}")
        tab.wait_for(lambda text: "set_config_param" in text)
        tab.open(f"http://127.0.0.1:{port}/{START}")
        tab.wait_for(lambda text: text.strip() == "{}")
        tab.open(f"http://127.0.0.1:{port}/api/v1/sensor/config")
        tab.wait_for(lambda text: '"udp_dest": "127.0.0.77"' in text)
    assert [destination.host for destination in asked] == ["127.0.0.77"]


def test_a_website_that_knows_the_address_of_a_page_may_link_to_it_only(new_tab, tmp_path):
    view = spiral_view(spiral(tmp_path / "cloud.ply", WET))
    orders = []
    questions = []

    def answer(question, *others):
        questions.append(question)
        return view.answer(question, *others)

    with page_server(answer, 0, lambda: orders.append("stop")) as page:
        urls = [f"{page.url}{what}" for what in ("stop", "state", "")]
        with website(urls, page.url) as port:
            tab = new_tab(f"http://localhost:{port}/")
            wait_for_requests(tab, page.token)
            assert (orders, questions) == ([], [])
            tab.value("document.querySelector('a').click()")
            tab.wait_for(lambda text: "30,000 points" in text)
    assert orders == []
