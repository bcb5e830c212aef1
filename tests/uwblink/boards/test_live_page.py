"""The live page: its content, its access rules, and its display in a browser if there is one."""

import contextlib
import re
import signal
import socket
import struct
import subprocess
import threading
import time
import urllib.error
import urllib.request
from unittest import mock

import numpy as np
import pytest

import uwblink
from tests.boards import After, bench_scenario, record_bench, served
from tests.browser import chromium
from tests.processes import BIN, wait_until
from uwblink.boards import LivePage, Progress, live_page
from uwblink.boards.listeners import PairState, Turn
from uwblink.recording.schema import Fault
from uwblink.wire import RangeReport
from uwbsim import VirtualPorts


def fetch(page, path="", method="GET", **headers):
    data = None if method == "GET" else b"C09\r"
    request = urllib.request.Request(page.url + path, data, headers, method=method)  # noqa: S310 - its own address
    with urllib.request.urlopen(request, timeout=30) as answer:  # noqa: S310
        return answer.headers, answer.read().decode()


def recorded(tmp_path, page, look):
    """Record three seconds, and return the result and what a look at the page after 250 exchanges shows."""
    ports, seen = VirtualPorts(bench_scenario(), lost_share=0.1), []
    listeners = [page, After(t250=lambda: seen.append(look()))]
    how = {"duration_s": 3.0, "listeners": listeners, "watch": page.watch}
    return record_bench(tmp_path / "f.uwb", uwblink.RangingPlan(rate_hz=100.0), ports, **how), seen[0]


def corrected(exchanges):
    return {"corrected_m": exchanges.range_m - 0.125, "sigma_m": np.full(len(exchanges), 0.034)}


def test_the_page_shows_rates_success_ranges_power_faults_disk_and_queue(tmp_path):
    with LivePage(tmp_path / "f.uwb", correct=corrected) as page:
        done, (headers, text) = recorded(tmp_path, page, lambda: fetch(page))
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    rows = re.findall(r"<tr><td>(\d)&nbsp;&rarr;&nbsp;(\d)</td>(.*?)</tr>", text)
    assert {(int(a), int(b)) for a, b, _ in rows} == set(done.pairs)
    for *_, cells in rows:
        rate, success, power, distance, shorter, spread, sigma, picture = re.findall(r"<td>(.*?)</td>", cells)
        assert 20 < float(rate) < 40
        assert 80 < float(success.removesuffix(" %")) <= 100
        assert float(shorter) == pytest.approx(float(distance) - 0.125, abs=0.0011)
        assert (2 < float(spread) < 6, sigma) == (True, "3.4")
        assert -100 < float(power) < -70
        assert picture.count("<polyline") == 2
        assert len(re.findall(r"[\d.]+,[\d.]+", picture)) > 100
    assert re.search(r"file [\d.]+ MB, disk [\d.]+ GB free; queue: \d+ rows, last commit [\d.]+ s ago", text)
    assert "faults: none" in text or "failed exchange" in text


def test_the_picture_is_the_last_minute(tmp_path):
    """Host time is a large number."""
    began_ns = 1_790_000_000_000_000_000
    with LivePage(tmp_path / "f.uwb") as page:
        progress = Progress(start_ns=began_ns, pairs={(1, 2): PairState()})
        page.watch(progress)
        for k in range(90):
            report = RangeReport(2, 3.0 + 0.01 * k, 1, 2, 3, 4, 5, 6, -85.0, -86.0, 0.0, 0.0)
            progress.on_turn(Turn(began_ns + k * 1_000_000_000, (1, 2), report))
        progress.time_s = 95.0
        text = page.body()
    drawn = re.findall(r"([\d.]+),([\d.]+)", re.search(r'points="([^"]*)"', text)[1])
    across, down = ([float(place[k]) for place in drawn] for k in (0, 1))
    # 61 ranges of a minute, a second apart, over 254 of 260 units; they become longer, so they are drawn higher.
    assert len(drawn) == 61
    assert across == pytest.approx([3 + 254 * k / 60 for k in range(61)], abs=0.06)
    assert down == pytest.approx([41 - 38 * k / 60 for k in range(61)], abs=0.06)
    # The last range was six seconds ago.
    for words in ("range from 3.290 to 3.890 m", "<small>3.29 to 3.89 m, 60 s</small>", "class='silent'"):
        assert words in text
    assert "corrected" not in text, "there is no calibration"


def test_the_page_shows_success_of_ten_seconds_noise_and_gaps(tmp_path):
    """20 s of ranges of a moving tag with planted noise, and a gap of 5 s; in the last 10 s every second turn fails."""
    began_ns, noise = 1_790_000_000_000_000_000, np.random.default_rng(7).normal(0, 0.05, 200)
    progress = Progress(start_ns=began_ns, time_s=25.0)
    for k in range(200):
        time_ns = began_ns + k * 100_000_000 + 5_000_000_000 * (k >= 100)
        report = RangeReport(2, 3.0 + 0.1 * k + noise[k], 1, 2, 3, 4, 5, 6, -85.0, -86.0, 0.0, 0.0)
        progress.on_turn(Turn(time_ns, (1, 2), report))
        if k >= 100:
            progress.on_turn(Turn(time_ns, (1, 2), None))
    with LivePage(tmp_path / "f.uwb") as page:
        page.watch(progress)
        cells = re.findall(r"<td>(.*?)</td>", page.body())
    assert cells[2] == "50 %", "the whole recording has 67 %"
    # 198 second differences determine a spread to a tenth.
    assert float(cells[5]) == pytest.approx(5.0, rel=0.25)
    assert cells[-1].count("<polyline") == 2
    assert live_page.spread_cm([np.nan] * 12) == "", "a correction may have no result"


def test_an_unplugged_board_stays_named_until_it_is_back(tmp_path):
    progress, noon_ns = Progress(), 1_790_000_000_000_000_000
    with LivePage(tmp_path / "f.uwb") as page:
        page.watch(progress)
        progress.on_fault(Fault(noon_ns, "3", "unplugged", "gone"))
        for _ in range(20):
            progress.on_fault(Fault(noon_ns + 1, "1", "text", "noise"))
        away = page.body()
        progress.on_fault(Fault(noon_ns + 9, "3", "replugged", "board 3 is back"))
        back = page.body()
    clock = time.strftime("%H:%M:%S", time.localtime(noon_ns * 1e-9))
    assert f"board 3 is unplugged since {clock}" in away
    assert f"<li>{clock} board 1: text: noise</li>" in away
    assert "unplugged since" not in back


def test_output_of_boards_is_escaped_in_the_page(tmp_path):
    progress = Progress()
    progress.on_fault(Fault(0, "1", "text", "<script>alert(1)</script>"))
    with LivePage(tmp_path / "<f>.uwb") as page:
        page.watch(progress)
        _, text = fetch(page)
    assert "<script>alert" not in text
    for words in ("&lt;script&gt;alert(1)&lt;/script&gt;", "recording &lt;f&gt;.uwb"):
        assert words in text


def test_the_page_is_served_to_this_computer_only(tmp_path):
    with LivePage(tmp_path / "f.uwb") as page:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", page.url)
        headers, text = fetch(page)
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert not re.findall(r"(?:src|href)=", text)
        for path, host, method, status in (
            ("", "evil.example", "GET", 403),
            ("body", "evil.example:8000", "GET", 403),
            ("", "127.0.0.1.evil.example", "GET", 403),
            ("", "localhost.evil.example:80", "GET", 403),
            ("", "", "GET", 403),
            ("../etc/passwd", "localhost", "GET", 404),
            ("x", "localhost", "GET", 404),
            *(("", "localhost", method, 501) for method in ("POST", "PUT", "DELETE", "OPTIONS")),
        ):
            with pytest.raises(urllib.error.HTTPError) as refused:
                fetch(page, path, method, Host=host)
            refused.value.close()
            assert refused.value.code == status
        with pytest.raises(uwblink.errors.PortError, match="cannot be served there"):
            LivePage(tmp_path / "f.uwb", port=port_of(page))


def port_of(page):
    return int(page.url.rsplit(":", 1)[1].rstrip("/"))


def connected(page):
    return socket.create_connection(("127.0.0.1", port_of(page)), timeout=20)


def test_faulty_connections_have_no_effect(tmp_path, capfd):
    requests = (
        b"",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /body",
        b"\x00\xff" * 50_000,
        b"X" * 70_000 + b"\r\n",
    )
    with LivePage(tmp_path / "f.uwb") as page:
        for request in requests * 8:
            with connected(page) as client:
                # Closing sends a reset if an answer arrives later.
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                with contextlib.suppress(OSError):
                    client.sendall(request)
        assert fetch(page)[0]["Content-Type"] == "text/html; charset=utf-8"
        wait_until(lambda: not any("process_request_thread" in thread.name for thread in threading.enumerate()))
    assert capfd.readouterr() == ("", "")


def test_silent_connections_are_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(live_page._Handler, "timeout", 0.05)
    with LivePage(tmp_path / "f.uwb") as page, connected(page) as client:
        client.sendall(b"GET / HT")
        assert client.recv(100) == b"", "the other end hung up"


def test_pages_of_an_earlier_recorder_are_detected(tmp_path):
    """The next recorder may have the same port while the page of the previous one is still open."""
    with LivePage(tmp_path / "old.uwb") as page:
        _, whole = fetch(page)
    with LivePage(tmp_path / "new.uwb", port=port_of(page)) as page:
        _, body = fetch(page, "body")
    before, main, after = re.split("</?main>", whole.partition("</title>")[2])
    assert ("recording old.uwb" in main, "recording new.uwb" in body) == (True, True)
    assert "old.uwb" not in before + after, "what is not fetched again says nothing of a recording"


@pytest.mark.slow
def test_a_browser_shows_the_live_page_and_updates_it(tmp_path):
    """Headless Chromium runs the script under the page's own policy, and fetches the body again."""

    def look():
        return chromium("--virtual-time-budget=3000", "--dump-dom", page.url, profile=tmp_path / "profile")

    with LivePage(tmp_path / "f.uwb") as page:
        body = page.body = mock.Mock(wraps=page.body)  # type: ignore[method-assign]
        _, done = recorded(tmp_path, page, look)
    assert (done.count("<polyline") >= 3, "recording f.uwb" in done) == (True, True)
    assert body.call_count >= 2, "the script fetches the body again"


def test_the_command_prints_the_address_of_the_page_and_serves_it(tmp_path):
    with served() as server:
        ports = [str(name) for name in server.names.values()]
        words = [str(BIN / "uwblink"), "record", *ports, "-o", str(tmp_path / "f.uwb"), "--pairs", "all", "--live"]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        url = re.search(r"live page: (http://127\.0\.0\.1:\d+/)", process.stderr.readline())[1]

        def drawn():
            with urllib.request.urlopen(url + "body", timeout=30) as answer:  # noqa: S310 - the page's own address
                return answer.read().decode().count("<polyline")

        wait_until(lambda: drawn() == 3, process)  # three pairs, without a calibration
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, " exchanges in " in out) == (0, True), err
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=5)  # noqa: S310
