"""The page of a scanner in a browser, while its loop goes on."""

import itertools
import re
import threading

import pytest

from lidarpool import Actor, Pose, Scanner, Scene, Sensor, box, show

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_sweeps_follow_one_another_and_the_end_is_told(new_tab):
    scene = Scene.from_meshes([box("Floor", (200, 200, 0.1))])
    scanner = Scanner(scene.with_actors([Actor(box("Car 1", (4, 2, 1.5)))]), Sensor.grid(400, 8))
    over = threading.Event()
    with show(scanner, to=":0") as view:

        def scan():
            for number in itertools.count():
                pose = Pose((0.02 * number, 0, 1.5))
                scanner.move("Car 1", Pose((6 + 0.02 * number, 3, 0)))
                view.show(scanner.sweep(pose), pose)
                if over.wait(0.05):
                    return

        tab = new_tab(view.url)
        tab.wait_for(lambda text: "waiting for the first sweep" in text)
        thread = threading.Thread(target=scan)
        thread.start()
        try:
            tab.wait_for(lambda text: re.search(r"[1-9][\d,]* points", text) and "Car 1" in text)
            assert "Stop" not in tab.text
            first = tab.value("lidarpool.picture.sensors[0].at[0]")
            tab.click("Follow")
            before = tab.value("lidarpool.picture.camera.position.x")
            tab.wait_for(lambda _: tab.value("lidarpool.picture.sensors[0].at[0]") > first + 0.1)
            assert tab.value("lidarpool.picture.camera.position.x") > before
            assert tab.value("lidarpool.picture.actors[0].at[0]") > 6
            assert tab.errors == []
        finally:
            over.set()
            thread.join()
    tab.wait_for(lambda text: "The server for this page has stopped." in text)
