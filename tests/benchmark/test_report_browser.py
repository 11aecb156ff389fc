"""The report in a real browser, without a network."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.report import report
from nss_ros.benchmark.run import measured_run
from nss_ros.benchmark.run_timing import RunTiming
from nss_ros.multiway.pose_graph import EdgeStatus

playwright = pytest.importorskip("playwright.sync_api")

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium here")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
NO_WEBGL = """
const context = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.includes("webgl") ? null : context.call(this, kind, ...rest);
};
"""
_PATIENCE = 120_000  # milliseconds; the first page of a browser on a busy machine takes long
DESKTOP, PHONE = {"width": 1280, "height": 900}, {"width": 360, "height": 740}


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def page_file(make_run, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "browser_report.html"
    if path.exists():  # of the test before
        return path
    log = make_run(wrong=(0, 1, 7))
    edges = tuple(
        replace(edge, status=EdgeStatus.REJECTED) if i in (0, 1, 7) else edge
        for i, edge in enumerate(log.pose_graph.edges)
    )
    log = replace(log, pose_graph=replace(log.pose_graph, edges=edges))
    times = np.arange(15, dtype=np.float64)
    timing = RunTiming(times[:6], times, log.pairs, times + 2, times * 0 + 2, times * 0 + 1)
    text = report([measured_run(log, timing, Bootstrap(20))], worst=2, most_points=4000)
    path.write_text(text, encoding="utf-8")
    return path


def opened(browser, path, init="", **options):
    """A page, what it complains of, and what it asks the network for."""
    page = browser.new_context(**options).new_page()
    page.set_default_timeout(_PATIENCE)
    page.add_init_script(init)
    complaints, requests = [], []
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on(
        "request",
        lambda r: requests.append(r.url) if not r.url.startswith(("file:", "data:")) else None,
    )
    page.goto(path.as_uri())
    return page, complaints, requests


def overflow(page):
    return page.evaluate("document.documentElement.scrollWidth - window.innerWidth")


def read_through(page):
    """Bring every chart into sight once, and wait until it is drawn."""
    for element in page.query_selector_all(".plot, .view"):
        # Playwright's own scrolling waits for two frames without motion, which a busy machine
        # may not draw within its patience.
        element.evaluate("e => e.scrollIntoView()")
        page.wait_for_function("e => e.querySelector('.main-svg')", arg=element)


def shown_traces(page):
    """The stages whose points the 3-D view shows, by number."""
    page.wait_for_function("document.querySelector('.view').data !== undefined")
    visible = page.evaluate("document.querySelector('.view').data.map(t => t.visible !== false)")
    return [i for i in range(len(visible) // 3) if visible[3 * i]]


def test_the_report_on_a_desktop(browser, page_file, tmp_path):
    page, complaints, requests = opened(browser, page_file, viewport=DESKTOP)
    read_through(page)
    assert complaints == []
    assert requests == []
    assert overflow(page) <= 0

    slider = page.locator(".model input[type=range]")
    slider.scroll_into_view_if_needed()
    label = page.locator(".model output")
    assert label.text_content() == "All 2 stages"
    assert shown_traces(page) == [0, 1]
    page.wait_for_timeout(300)
    everything = page.locator(".view").screenshot()
    slider.fill("0")
    assert label.text_content() == "Stage 1"
    assert shown_traces(page) == [0]
    page.wait_for_timeout(300)
    assert page.locator(".view").screenshot() != everything
    slider.press("ArrowRight")
    assert label.text_content() == "Stage 2"
    assert shown_traces(page) == [1]
    page.locator(".ceiling").check()
    assert page.evaluate("document.querySelector('.view').data[4].visible") is True

    # From a worst pair to its row, also when a filter hides that row.
    page.locator(".filters button", has_text="right").click()
    hidden = page.locator("tr.wrong").first
    assert not hidden.is_visible()
    page.locator(".worst a").first.click()
    row = page.locator("tr:target")
    row.wait_for()  # the page answers to its new address a little later
    assert "wrong" in row.text_content()
    assert row.locator("td").first.text_content() in page.locator(".worst a").first.text_content()
    page.locator(".filters input").fill("no such pair")
    assert page.locator(".all-pairs tbody tr:visible").count() == 0

    page.screenshot(path=tmp_path / "desktop.png", full_page=True)
    assert (tmp_path / "desktop.png").stat().st_size > 50_000
    assert complaints == []
    assert requests == []
    page.context.close()


def test_each_component_of_a_map_can_be_chosen(browser, make_run, cut, tmp_path):
    log = cut(make_run(), 3, 4, 6)
    times = np.zeros(0)
    timing = RunTiming(times, times, (), times, times, times)
    path = tmp_path / "parts.html"
    path.write_text(report([measured_run(log, timing, Bootstrap(0))], 1, 4000), encoding="utf-8")
    page, complaints, _ = opened(browser, path, viewport=DESKTOP)
    read_through(page)
    choice = page.locator(".model select")
    assert choice.locator("option").all_text_contents() == [
        "Area 1, component 1 of 3 (3 fragments)",
        "Area 1, component 2 of 3 (2 fragments)",
        "Area 1, component 3 of 3 (1 fragment)",
    ]
    # Three of stage 1, then two of stage 2.
    assert page.locator(".model output").text_content() == "Stage 1"
    ids = "document.querySelector('.view').data.filter(t => t.text).flatMap(t => t.text)"
    assert page.evaluate(ids) == [f"Bldg1_Stage1_Spot{spot}" for spot in range(3)]
    before = page.locator(".view").screenshot()
    choice.select_option(index=1)
    assert page.evaluate(ids) == ["Bldg1_Stage2_Spot1", "Bldg1_Stage2_Spot2"]
    page.wait_for_timeout(300)
    assert page.locator(".view").screenshot() != before
    assert overflow(page) <= 0
    assert complaints == []
    page.context.close()


def test_the_report_on_a_phone(browser, page_file, tmp_path):
    page, complaints, requests = opened(
        browser, page_file, viewport=PHONE, is_mobile=True, has_touch=True
    )
    read_through(page)
    assert overflow(page) <= 0
    widths = page.evaluate(
        "[...document.querySelectorAll('.plot .main-svg')]"
        ".map(e => e.getBoundingClientRect().right)"
    )
    assert max(widths) <= PHONE["width"]
    # A drag on a chart must scroll the page.
    assert page.evaluate("document.querySelector('.plot').layout.dragmode") is False
    page.locator(".model input[type=range]").fill("1")
    assert shown_traces(page) == [1]
    page.screenshot(path=tmp_path / "phone.png", full_page=True)
    assert complaints == []
    assert requests == []
    page.context.close()


def test_the_report_on_paper(browser, page_file, tmp_path):
    page, complaints, _ = opened(browser, page_file, viewport=DESKTOP)
    page.emulate_media(media="print")
    assert page.locator(".panels:visible, .model:visible, nav:visible").count() == 0
    assert page.locator("img.still:visible").count() == page.locator("img.still").count() > 5
    page.pdf(path=tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    assert complaints == []
    page.context.close()


def test_the_report_where_little_works(browser, page_file):
    page, complaints, _ = opened(browser, page_file, viewport=DESKTOP, init=NO_WEBGL)
    page.locator(".model .view").scroll_into_view_if_needed()
    page.wait_for_selector(".view.missing")
    assert "the pictures below show the map" in page.locator(".view").text_content()
    page.locator(".model input[type=range]").fill("0")
    assert complaints == []
    page.context.close()

    page, _, _ = opened(browser, page_file, viewport=DESKTOP, java_script_enabled=False)
    assert page.locator("img.still").first.is_visible()
    assert not page.locator(".model").first.is_visible()
    page.context.close()
