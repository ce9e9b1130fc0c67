# SPDX-License-Identifier: Apache-2.0
"""Figures stand once: benchmarks write them into a file, a page is made of it, and other pages link to that."""

import json
import re
import sys
from itertools import combinations
from pathlib import Path

import pytest
import results

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CODE = re.compile(r"```.*?```|<!--.*?-->|`[^`]*`|\]\([^)]*\)", re.DOTALL)
NUMBER = re.compile(
    r"(?<![\w.,:/^-])\d[\d,]*(?:\.\d+)?(?![\w/]|[.:]\d)(\s?(?:%|°|(?:[mun]?s|h|[mck]?m|[kMGT]?B|Hz|px)\b))?"
)
ENOUGH = 5
"""Significant digits that two rows or paragraphs must share, with three of them in one number, to be no coincidence."""


def digits(number):
    """Return the number of significant digits; zeros at the end of a whole number do not count."""
    return len(number.replace(".", "").lstrip("0") if "." in number else number.strip("0"))


def measured(text):
    """Return the numbers of a row or paragraph that could be measured.

    In a row of a table these are numbers with a unit or three significant digits, elsewhere those with a unit or
    thousands. Years, and powers of two less one or none, are limits of formats.
    """
    found, least = set(), 3 if text.startswith("|") else 5
    for match in NUMBER.finditer(text):
        number = match[0].removesuffix(match[1] or "").rstrip(",")
        bare = number.replace(",", "")
        whole = int(bare) if bare.isdigit() else 3
        if not (match[1] or "," in number or digits(bare) >= least):
            continue
        if re.fullmatch(r"(?:19|20)\d\d", number) or (whole > 100 and whole & (whole + 1) * (whole - 1) == 0):
            continue
        found.add(bare)
    return found


def parts(text):
    """Return the rows, items and paragraphs of a page, without code and targets of links."""
    for paragraph in re.split(r"\n\s*\n", CODE.sub(" ", text)):
        yield from re.split(r"\n(?=[|-])", paragraph.strip()) if paragraph.strip() else ()


def standing_twice(pages):
    """Return pairs of places on two pages that share too many digits to be a coincidence."""
    places = [(name, part, measured(part)) for name, text in pages.items() for part in parts(text)]
    for (name, part, numbers), (other, same, others) in combinations(places, 2):
        shared = sorted(numbers & others)
        if name != other and max(map(digits, shared), default=0) >= 3 and sum(map(digits, shared)) >= ENOUGH:
            yield f"{', '.join(shared)}\n  {name}: {part[:150]}\n  {other}: {same[:150]}"


def test_no_figure_stands_on_two_pages():
    twice = list(standing_twice({page.name: page.read_text() for page in PAGES}))
    assert not twice, "state these once, and link to them elsewhere:\n" + "\n".join(twice)


HERE = "| an hour of depth frames, 0.1 m: memory, time p99 | 0.08 %, 2.32 ms | `soak.py` |"
TWICE = {
    "both tables": (HERE, "| what | RSS |\n|---|---|\n| depth, 0.1 m | +0.08 % (341.7 MB) | 1.53, 2.32 |"),
    "table and text": ("| kept frame; a minute | 82 kB; 148 MB |", "Each image takes 82 kB, or\n148 MB a minute."),
    "two texts": ("It has 83 % right,\n99.8 % within a cell.", "- walls are thick (83 % right, 99.8 % near)"),
    "one long number": ("Of 1,019,366 cells.", "| cells | 1,019,366 |"),
}
ONCE = {
    "conditions": ("Cells of 0.05 m, 30 Hz, up to 5 m, 250 frames.", "| 0.05 m | 30 Hz | 5 m, 250 frames |"),
    "one number by chance": (HERE, "| 16 px | 2.32 ms |"),
    "small numbers by chance": ("| KITTI scenes 7, 13, 22 | 1.44 % |", "| 3 Hz | 13; 22; 7 |"),
    "formats": ("| 65535 | no value |", "65535 px is no value, 0.001 m."),
    "settings and commands": ("`a=12.34 b=56.78`", "```bash\nrun 12.34 56.78\n```"),
    "years": ("| Chien 2020 | 12.5 |", "| Chien 2020 | 13.5 |"),
}


@pytest.mark.parametrize("case", TWICE)
def test_a_figure_that_stands_twice_is_found(case):
    here, there = TWICE[case]
    assert len(list(standing_twice({"a.md": here, "b.md": f"Else.\n\n{there}"}))) == 1
    assert not list(standing_twice({"a.md": f"{here}\n\n{there}"}))


@pytest.mark.parametrize("case", ONCE)
def test_what_pages_may_share(case):
    here, there = ONCE[case]
    assert not list(standing_twice({"a.md": here, "b.md": there}))


@pytest.mark.parametrize("name", ["choosing.md", "speed.md", "benchmark.md"])
def test_pages_about_speed_link_to_figures(name):
    """A rounded or old figure shares no digits with the new one, so these pages have none."""
    text = CODE.sub(" ", (ROOT / "docs" / name).read_text())
    assert not re.findall(r"\d\s?(?:ms|us|MB)\b|\d times as", text)
    assert "(figures.md" in (ROOT / "docs" / name).read_text()


def test_the_readme_states_the_speed_that_was_measured():
    """Whole calls with cells of 0.1 and 0.05 m, on both kinds of processors."""
    both = [results.load()[name].values["whole"][1:] for name in ("speed", "speed_avx2")]
    low, high = min(map(min, both)), max(map(max, both))
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"in {low:.1f} to {high:.1f} ms per frame, with cells of 0.1 to 0.05 m" in text


def test_every_result_is_on_the_page_with_its_command():
    template = results.TEMPLATE.read_text()
    for name, result in results.load().items():
        assert result.values
        assert result.machine
        assert result.date
        assert {key for key in result.find if "{" not in key} <= set(result.values), name
        assert all(re.compile(place).groups == 1 for place in result.find.values() if "(" in place), name
        assert f"{{{name}[" in template or f"{{{name}." in template, name
    assert not [number for text in parts(template) for number in measured(text) if digits(number) > 2]


PRINTS_JSON = """
import json, sys
rows = [{"library": name, "size": size, "ms": size * 2} for size in (0.1, 0.05) for name in ("ours", "theirs")]
print("--json" in sys.argv)
print(json.dumps({"rows": rows, "times": {"p99": 2.5}}))
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "results.json").write_text("{}")
    return tmp_path / "results.json"


def test_a_command_is_run_and_what_it_prints_recorded(file, tmp_path):
    (tmp_path / "a b.py").write_text(PRINTS_JSON)
    find = {"{library}": "rows[*].ms", "small": "rows[library=ours,size=0.05].ms", "p99": "times.p99"}
    file.write_text(json.dumps({"a": {"command": "python 'DIR/a b.py'", "machine": "", "date": "", "find": find}}))
    results.measure("a", {"DIR": str(tmp_path)}, file=file)
    result = results.load(file)["a"]
    assert result.values == {"ours": [0.2, 0.1], "theirs": [0.2, 0.1], "small": 0.1, "p99": 2.5}
    assert (result.command, result.find) == ("python 'DIR/a b.py'", find)
    assert result.machine == results.processor()
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", result.date)
    first = file.read_text()
    results.measure("a", {"DIR": str(tmp_path)}, file=file)
    assert file.read_text() == first


def test_a_new_command_and_text_and_status(file, tmp_path, capsys):
    program = tmp_path / "program.py"
    program.write_text("print('1,234 cells of 5\\nmedian 0.25 ms\\nmedian 0.5 ms'); raise SystemExit(1)")
    find = {"cells": r"^([\d,]+) cells", "ms": r"median ([\d.]+) ms"}
    file.write_text(json.dumps({"a": {"command": "old", "machine": "", "date": "", "find": find}}))
    results.measure("a", {}, f"{sys.executable} {program}", file)
    assert results.load(file)["a"].values == {"cells": 1234, "ms": [0.25, 0.5]}
    assert "status 1" in capsys.readouterr().err
    file.write_text(json.dumps({"a": {"command": "old", "machine": "", "date": "", "find": {"x": "rows[*].ms"}}}))
    before = file.read_text()
    for name, replaced in (("a", "x: the output has no"), ("b", "b: nothing to record")):
        with pytest.raises(SystemExit, match=replaced):
            results.measure(name, {}, f"{sys.executable} {program}", file)
    with pytest.raises(SystemExit, match="b: no such entry"):
        results.measure("b", {}, "", file)
    assert file.read_text() == before


def test_programs_get_json_if_they_know_it(tmp_path):
    (tmp_path / "knows.py").write_text('add_argument("--json")')
    (tmp_path / "not.py").write_text("")
    for name, more in (("knows.py", ["--json"]), ("not.py", [])):
        script = str(tmp_path / name)
        assert results._with_json(["python", script, "10"]) == ["python", script, *more, "10"]
    assert results._with_json(["env", "A=1", "stereovox", "bench", "X"]) == [
        "env",
        "A=1",
        "stereovox",
        "bench",
        "--json",
        "X",
    ]


def test_the_page_is_made_of_the_results(tmp_path, file):
    entries = {"a": {"values": {"n": 1234, "row": [0.2812, 12.34], "s": [0.061, 0.3]}}, "b": {"values": {"m": 2.0}}}
    for name, machine, date in (("a", "big", "not recorded"), ("b", "small", "2026-01-02")):
        entries[name] |= {"command": f"run {name}", "machine": machine, "date": date}
    file.write_text(json.dumps(entries | {"c": entries["a"]}))
    template = tmp_path / "page.md.in"
    template.write_text(
        "| {a[row]} | {a[n]} {a[s]:pairs*100} {a[s]:span} {a[s]:;} {b[m]:.1f} {b.run} {a.run} {machines}"
    )
    page = "| 0.281 | 12.3 | 1,234 6.1, 30 0.061 to 0.3 0.061; 0.3 2.0 `run b`¹ `run a` big; ¹small, 2026-01-02"
    assert results.page(file, template) == page
