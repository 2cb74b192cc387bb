"""The report's page in Chromium: sorting, filtering, sequences, pictures, and whether everybody can use it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from paged import hostile, ordinary, page_of, pictured

sync_api = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.extras,
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
]
PHONE = {"width": 390, "height": 844}
DESK = {"width": 1280, "height": 900}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    # pytest's own warnings as errors are not for a library's event loop.
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


class Reader:
    """Somebody who reads a page, and remembers what the browser complained of or asked for."""

    def __init__(self, browser: Any, path: Path, size: dict[str, int] = DESK, scheme: str = "light") -> None:
        self.context = browser.new_context(viewport=size, color_scheme=scheme)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("dialog", self._dialog)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())

    def _dialog(self, dialog: Any) -> None:
        self.complaints.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    def names(self, board: int = 0) -> list[str]:
        """Of the rows of a table that are seen, from above."""
        rows = self.page.locator(f"#board-{board} tbody tr:visible th a")
        return [text.strip() for text in rows.all_inner_texts()]

    def leave(self) -> None:
        """See that there was nothing to complain of, and that nothing else was loaded."""
        assert self.complaints == []
        assert [url for url in self.asked if not url.startswith(("file:", "data:"))] == []
        assert sum(url.startswith("file:") for url in self.asked) == 1
        self.context.close()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plain")
    page = page_of(ordinary(folder / "runs"), published=["hu2026"])
    (folder / "page.html").write_text(page, encoding="utf-8")
    return folder / "page.html"


@pytest.fixture(scope="module")
def with_pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictured")
    (folder / "page.html").write_text(page_of(pictured(folder)), encoding="utf-8")
    return folder / "page.html"


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures, failures, and figures of others."""
    folder = tmp_path_factory.mktemp("everything")
    page = page_of(ordinary(pictured(folder)), published=["banks2025"])
    (folder / "page.html").write_text(page, encoding="utf-8")
    return folder / "page.html"


def test_a_table_is_sorted_by_any_column(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    assert reader.names() == ["better", "worse", "broken"]
    head = reader.page.locator("#board-0 thead th:visible", has_text="latency")
    button = head.get_by_role("button")
    button.press("Enter")
    assert head.get_attribute("aria-sort") == "ascending"
    assert reader.names() == ["better", "worse", "broken"]  # what has no value is last
    button.press("Enter")
    assert head.get_attribute("aria-sort") == "descending"
    assert reader.names() == ["worse", "better", "broken"]
    button.click()
    assert head.get_attribute("aria-sort") == "none"
    assert reader.names() == ["better", "worse", "broken"]
    reader.page.locator("#board-0 thead th").first.get_by_role("button").click()
    assert reader.names() == ["better", "broken", "worse"]
    reader.leave()


def test_rows_are_filtered_by_text_and_status(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    search = reader.page.get_by_label("Search rows")
    search.fill("WORSE")
    assert reader.names() == ["worse"]
    assert "1 of" in reader.page.get_by_role("status").inner_text()
    search.fill("")
    reader.page.get_by_label("Status").select_option("failed")
    assert reader.names() == ["broken"]
    assert "ValueError: step | returned (3,)" in reader.page.locator(".reason").inner_text()
    reader.page.get_by_label("Status").select_option("quoted")
    assert reader.names() == []
    assert reader.page.get_by_text("Hu et al. 2026, Table I, single-arm, synthetic").first.is_visible()
    reader.leave()


def test_all_columns_are_there_when_asked_for(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    hash_ = reader.page.locator("#board-0 thead th", has_text="settings_hash")
    assert not hash_.is_visible()
    reader.page.get_by_label("All columns").check()
    assert hash_.is_visible()
    reader.leave()


def test_a_row_leads_to_where_it_is_from_and_back(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    reader.page.locator("#board-0").get_by_role("link", name="better").click()
    fold = reader.page.locator("details.origin[open]")
    assert fold.count() == 1
    assert "Processor of the test" in fold.inner_text()
    reader.page.get_by_label("Search rows").fill("nothing of the kind")
    fold.get_by_role("link").click()
    assert "better" in reader.names()  # a row that is led to is not left filtered away
    assert reader.page.evaluate("document.activeElement.id") == "row-0"
    reader.leave()


def test_points_lead_to_their_rows(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    points = reader.page.locator("#scatter a")
    assert points.count() == 2
    assert points.first.get_attribute("aria-label") == "better: 0.025  at 11.5 ms"
    points.nth(1).focus()
    reader.page.keyboard.press("Enter")
    reader.page.wait_for_function("document.activeElement.id === 'row-1'")
    reader.page.get_by_role("combobox", name="Error").first.select_option(label="tips [mm]")
    assert "tips" in str(reader.page.locator("#scatter svg").get_attribute("aria-label"))
    reader.leave()


def test_a_sequence_is_opened_and_its_lines_drawn(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    assert reader.page.locator("#curves polyline").count() == 2
    reader.page.get_by_label("Sequence", exact=True).select_option("000-right")
    assert "000-right" in str(reader.page.locator("#curves svg").get_attribute("aria-label"))
    reader.page.locator("#curve-legend").get_by_label("worse").uncheck()
    assert reader.page.locator("#curves polyline").count() == 1
    reader.page.locator("#curve-measure").select_option(label="latency [ms]")
    reader.page.get_by_label("Logarithmic").check()
    assert "NaN" not in reader.page.locator("#curves").inner_html()
    mark = reader.page.locator("#curves").get_by_role("button", name="worst moment of better")
    mark.press("Enter")
    assert "There is no picture" in reader.page.locator("#shown").inner_text()
    reader.leave()


def test_marked_moments_show_their_pictures(browser: Any, with_pictures: Path) -> None:
    reader = Reader(browser, with_pictures)
    reader.page.locator("#curves").get_by_role("button", name="worst moment of near").focus()
    image = reader.page.locator("#shown img")
    assert image.evaluate("(image) => image.decode().then(() => image.naturalWidth)") == 88
    reader.page.get_by_role("button", name="frame 0: mask error 0.020", exact=True).click()
    assert "best moment of near" in str(image.get_attribute("alt"))
    assert film_plays(reader)
    reader.leave()


def film_plays(reader: Reader) -> bool:
    clip = reader.page.locator("details.clip").first
    clip.locator("summary").click()
    played = "(video) => video.play().then(() => video.videoWidth, (error) => String(error))"
    return bool(clip.locator("video").evaluate(played) == 88)


def test_films_play_without_the_extra_too(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgbench.report.encoders.has_h264", lambda: False)
    page = tmp_path / "page.html"
    page.write_text(page_of(pictured(tmp_path)), encoding="utf-8")
    reader = Reader(browser, page)
    assert film_plays(reader)
    reader.leave()


def test_nothing_of_strangers_runs(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(page_of(hostile(tmp_path / "runs")), encoding="utf-8")
    reader = Reader(browser, tmp_path / "page.html")
    reader.page.get_by_label("All columns").check()
    reader.page.get_by_label("Search rows").fill("<img")
    reader.page.locator("#curves [role=button]").first.press("Enter")
    reader.page.locator("#curve-table button").first.click()
    reader.page.locator("#scatter a").first.press("Enter")
    for fold in reader.page.locator("details.origin").all():
        fold.locator("summary").click()
    assert reader.page.locator("img").count() == 0
    assert "alert(1)" in reader.page.locator("main").inner_text()
    reader.page.wait_for_timeout(200)
    reader.leave()


def test_the_page_itself_does_not_scroll_sideways(browser: Any, with_pictures: Path, plain: Path) -> None:
    for path in (with_pictures, plain):
        reader = Reader(browser, path, PHONE)
        reader.page.get_by_label("All columns").check()
        assert reader.page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        assert reader.page.locator("#board-0 .scroll").evaluate("(box) => box.scrollWidth > box.clientWidth")
        reader.leave()


def test_the_keyboard_begins_with_a_way_to_the_tables(browser: Any, plain: Path) -> None:
    reader = Reader(browser, plain)
    reader.page.keyboard.press("Tab")
    assert "Skip" in reader.page.evaluate("document.activeElement.textContent")
    reader.page.keyboard.press("Enter")
    assert reader.page.evaluate("document.activeElement.id") == "main"
    reader.leave()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_barriers(browser: Any, everything: Path, scheme: str, size: dict[str, int]) -> None:
    reader = Reader(browser, everything, size, scheme)
    reader.page.get_by_label("All columns").check()
    reader.page.locator("#curves [role=button]").first.press("Enter")
    reader.page.evaluate("for (const fold of document.querySelectorAll('details')) fold.open = true")
    found = axe.Axe().run(reader.page).response["violations"]
    assert [(one["id"], [node["html"][:200] for node in one["nodes"]]) for one in found] == []
    reader.leave()
