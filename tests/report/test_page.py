"""The report's page as text: what it says, and what a browser is kept from doing."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import shutil
from pathlib import Path
from typing import Any

import fabricate
import numpy as np
import pytest
from commandline import surgbench
from hypothesis import given, settings
from hypothesis import strategies as st
from paged import ATTACK, MARKUP, hostile, ordinary, page_of, pictured, silent

from surgbench.errors import DatasetError, NotFoundError
from surgbench.records.reader import read_records
from surgbench.report.page.boards import grouped
from surgbench.report.page.build import MOST_BYTES, build_page, embedded, read, render
from surgbench.report.page.content import Page, clipped
from surgbench.report.page.curves import curves_of, points_for, share_of, thinned, units_shown
from surgbench.report.page.moments import choose, chosen_units
from surgbench.report.page.pictures import NO_FILMS
from surgbench.report.render import markdown
from surgbench.report.rows import derive_rows


def element(page: str, tag: str, attributes: str = "") -> str:
    """What stands in the first element of a kind."""
    found = re.search(rf"<{tag}{attributes}>(.*?)</{tag}>", page, re.DOTALL)
    assert found is not None
    return found[1]


def data_of(page: str) -> Any:
    return json.loads(element(page, "script", ' type="application/json" id="data"'))


def policy_of(page: str) -> dict[str, list[str]]:
    found = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert found is not None
    return {words[0]: words[1:] for part in html.unescape(found[1]).split(";") if (words := part.split())}


def test_the_policy_allows_the_pages_own_script_and_style_alone(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path))
    policy = policy_of(page)
    assert policy["default-src"] == policy["base-uri"] == policy["form-action"] == ["'none'"]
    assert policy["img-src"] == policy["media-src"] == ["data:"]
    for source, tag in (("script-src", "script"), ("style-src", "style")):
        digest = base64.b64encode(hashlib.sha256(element(page, tag).encode()).digest()).decode()
        assert policy[source] == [f"'sha256-{digest}'"]
    assert "unsafe" not in str(policy)
    assert " style=" not in page


def test_nothing_is_loaded_from_anywhere(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path))
    for target in re.findall(r'(?:src|href|poster|action|srcset)="([^"]*)"', page):
        assert target.startswith(("#", "data:")), target
    assert "@import" not in page
    assert "url(" not in page


def test_own_files_cannot_end_their_elements() -> None:
    assert "</" not in read("page.css")
    assert not re.search(
        r"</(script|style)|<!--|innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(", read("page.js")
    )


def test_whatever_a_record_says_is_text(tmp_path: Path) -> None:
    page = page_of(hostile(tmp_path))
    own = page.replace(element(page, "script", ' type="application/json" id="data"'), "")
    # Tags, without the texts between them and within their attributes.
    tags = re.findall(r"<(/?[a-zA-Z!][^\s>]*)((?:[^\"'>]|\"[^\"]*\"|'[^']*')*)>", own.replace(read("page.js"), ""))
    assert {"script", "/script"} <= {tag for tag, _ in tags}
    assert [attributes for tag, attributes in tags if tag == "script"] == [' type="application/json" id="data"', ""]
    assert not [attributes for tag, attributes in tags if re.search(r"\bon\w+\s*=", re.sub(r'"[^"]*"', "", attributes))]
    assert "img" not in {tag for tag, _ in tags}
    assert html.escape(ATTACK) in page  # it is there to be read
    assert "{{ 7 * 7 }}" in page
    assert data_of(page)["boards"][0]["rows"][0]["name"] == MARKUP


@settings(max_examples=30)
@given(st.recursive(st.text() | st.none() | st.integers(), lambda inner: st.dictionaries(st.text(), inner, max_size=3)))
def test_embedded_data_come_back_and_hold_no_markup(data: Any) -> None:
    text = embedded(data)
    assert json.loads(text) == data
    assert not set("<>&\u2028\u2029").intersection(text)


def test_it_says_what_the_markdown_page_says(tmp_path: Path) -> None:
    records = read_records([ordinary(tmp_path)])
    page = page_of(tmp_path)
    for line in markdown(derive_rows(records)).splitlines():
        if line.startswith("|") and "---" not in line:
            for cell in line.strip("|").split("|"):
                text = re.sub(r"\*\*|\\|\[.*?\]", "", cell).strip()
                assert html.escape(text) in page, text
    assert "failed: ValueError: step | returned (3,)" in html.unescape(page)


def test_best_and_second_are_marked(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path))
    assert "<strong>0.025</strong>" in page  # the mean of half a fifth of 0.1 to 0.4
    assert "<u>0.050</u>" in page


def test_every_row_says_where_it_is_from(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path))
    for fact in (
        "ab" * 32,
        "machine.processor",
        "Processor of the test",
        "tracker.options.population",
        "000-left, 000-right",
    ):
        assert fact in page
    assert "/somewhere" not in page  # nobody's folders
    anchors = set(re.findall(r'\bid="([^"]+)"', page))
    assert len(anchors) == len(re.findall(r'\bid="([^"]+)"', page))
    assert {target[1:] for target in re.findall(r'href="(#[^"]+)"', page)} <= anchors
    assert {row["anchor"] for board in data_of(page)["boards"] for row in board["rows"]} <= anchors


def test_records_that_differ_say_so(tmp_path: Path) -> None:
    for number, repeat in enumerate((0, 1, 2)):
        record = fabricate.record(repeat=repeat)
        record["environment"] = {"python": "3.11" if number else "3.12"}
        fabricate.write(tmp_path, record)
    assert "3.12 (1); 3.11 (2)" in page_of(tmp_path)


def test_a_dataset_that_is_gone_leaves_the_rest(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path))
    assert "Dataset &#39;mini&#39; is not where it was" in page
    assert "<img" not in page
    assert data_of(page)["boards"][0]["runs"]


def test_pictures_may_be_left_out(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path), pictures=0)
    assert "is not where it was" not in page
    assert "No pictures are on this page." in page


@pytest.mark.slow
def test_moments_are_drawn_and_filmed(tmp_path: Path) -> None:
    runs = pictured(tmp_path)
    page = page_of(runs)
    assert len(re.findall(r'<img src="data:image/webp;base64,', page)) == 6
    assert 'alt="worst moment of near on 000-right, frame 3: mask error 0.080"' in page
    assert len(re.findall(r'src="data:video/mp4;base64,', page)) == 6
    assert NO_FILMS.partition(":")[0] not in page
    moved = tmp_path / "moved"
    (tmp_path / "pairs").rename(moved)
    assert "<img" not in page_of(runs)
    assert "<img" in page_of(runs, dataset=moved)
    (moved / "dataset.json").write_text((moved / "dataset.json").read_text() + " ")
    with pytest.raises(DatasetError, match="not the dataset of any of these runs"):
        page_of(runs, dataset=moved)


@pytest.mark.slow
def test_a_picture_that_cannot_be_read_is_said_without_where_it_lies(tmp_path: Path) -> None:
    runs = pictured(tmp_path)
    for mask in (tmp_path / "pairs").rglob("000003.png"):
        mask.write_bytes(b"no picture")
    told: list[str] = []
    page = html.unescape(page_of(runs, tell=told.append))
    assert "near, 000-left: dataset 'pairs'" in page
    assert str(tmp_path) not in page
    assert any(str(tmp_path) in line for line in told)
    assert page.count("<img") == 4


@pytest.mark.slow
def test_without_an_encoder_there_are_stills_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("pictures", "build"):
        monkeypatch.setattr(f"surgbench.report.page.{module}.browsers_play", lambda: False)
    page = page_of(pictured(tmp_path))
    assert "<img" in page
    assert "<video" not in page
    assert NO_FILMS in html.unescape(page)


@pytest.mark.slow
def test_pictures_stop_where_the_page_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = pictured(tmp_path)
    bare = len(page_of(runs, pictures=0).encode())
    monkeypatch.setattr("surgbench.report.page.build.MOST_BYTES", bare + 6000)
    page = page_of(runs)
    assert 0 < len(re.findall("<img", page)) < 6
    assert "Some pictures or films are left out" in page
    assert len(page.encode()) < MOST_BYTES


def test_thinned_lines_keep_their_extremes() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=5000)
    values[1234], values[4321], values[100:200] = 9.0, -9.0, np.nan
    kept = thinned(values, 100)
    assert len(kept) <= 100
    assert {0, 1234, 4321, 4999} <= set(kept.tolist())
    assert (np.diff(kept) > 0).all()
    assert np.isfinite(values[kept]).all()
    assert thinned(values[:80], 100).tolist() == list(range(80))
    assert len(thinned(np.full(9, np.nan), 100)) == 0


def test_many_lines_have_few_points_each_and_not_all_sequences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (curves,) = map(curves_of, grouped(read_records([ordinary(tmp_path)])))
    assert curves.units == ("000-left", "000-right")
    assert points_for([curves]) == 400
    monkeypatch.setattr("surgbench.report.page.curves.ALL_POINTS", curves.lines * 50)
    assert points_for([curves]) == 100
    assert share_of([curves]) == 0.5
    assert units_shown(curves, 0.5) == ("000-left",)
    board = data_of(page_of(tmp_path, pictures=0))["boards"][0]
    assert (board["units"], board["unitsOfAll"]) == (["000-left"], 2)


def test_moments_are_the_best_the_median_and_the_worst() -> None:
    values = np.array([np.nan, 3.0, 1.0, 2.0, 9.0, 2.5])
    assert [(one.kind, one.place) for one in choose(values)] == [("best", 2), ("median", 5), ("worst", 4)]
    assert [one.kind for one in choose(np.array([1.0, 1.0]))] == ["best"]
    assert choose(np.array([np.nan])) == []


def test_sequences_are_those_that_the_best_row_is_best_and_worst_on(tmp_path: Path) -> None:
    for number, unit in enumerate(f"{one:03d}-left" for one in range(7)):
        record = fabricate.record(unit=unit)
        record["errors"]["mask_error"] = [float((number * 3) % 7)] * 4
        fabricate.write(tmp_path, record)
    (curves,) = map(curves_of, grouped(read_records([tmp_path])))
    assert chosen_units(curves, 0) == ["000-left", "001-left", "002-left"]  # 0, 3 and 6


def test_published_figures_are_quoted_in_tables_of_their_own(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path), published=["hu2026"])
    assert "Hu et al. 2026, Table I, single-arm, synthetic" in page
    assert "CMA-ES, 3 iterations, with joint readings" in page
    assert '<option value="quoted">quoted</option>' in page
    assert "0.2136" in page
    with pytest.raises(NotFoundError, match="hu2026"):
        page_of(tmp_path, published=["hu2025"])


def test_rows_are_compared_below_the_leaderboard(tmp_path: Path) -> None:
    page = page_of(ordinary(tmp_path))
    below = page[page.index('id="further"') :]
    assert page.index('id="further"') > page.index('id="leaderboard"')
    assert 'href="#further"' in page
    assert "Sequences won" in below
    assert "2:0" in below  # won on both sequences
    assert "too few for any difference to be significant" in below


def test_a_page_of_nothing_is_a_page() -> None:
    page = render(Page("nothing", "", (), data={"points": 0, "boards": []})).decode()
    assert "No pictures" in page
    assert clipped("a" * 9, 4) == "aaaa… (9 characters)"


def test_the_command_writes_it(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    runs, out = ordinary(tmp_path / "runs"), tmp_path / "deep" / "page.html"
    surgbench("report", runs, "--format", "html", "--out", out)
    assert out.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert [path.name for path in out.parent.iterdir()] == ["page.html"]
    capfd.readouterr()
    surgbench("report", runs, "--format", "html", "--pictures", 0)
    assert capfd.readouterr().out.encode() == build_page(read_records([runs]), silent, pictures=0)


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = ordinary(tmp_path / "runs")
    for arguments, said in (
        (("--pictures", 2), "--pictures: is for --format html"),
        (("--published", "hu2026"), "--published: is for --format html"),
        (
            ("--format", "html", "--out", tmp_path / "p.html", "--published", "hu"),
            "unknown source of published figures",
        ),
        (("--format", "html", "--out", tmp_path / "p.html", "--dataset", tmp_path / "none"), "no such folder"),
        (("--format", "html", "--out", tmp_path), "cannot be written"),
    ):
        surgbench("report", runs, *arguments, expect=2)
        error = capsys.readouterr().err
        assert said in error
        assert "Traceback" not in error
    shutil.rmtree(runs)
    surgbench("report", runs, "--format", "html", "--out", tmp_path / "p.html", expect=2)
    assert not (tmp_path / "p.html").exists()
