"""What README and documentation say is what the code does."""

from __future__ import annotations

import ast
import importlib
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import reduce
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

import benchmarks.rivals  # noqa: F401 - whose files a page names
import dynssm_ros
from benchmarks.paper.plan import load_plan
from benchmarks.paper.stale import marked
from dynssm_ros.cli.main import app
from dynssm_ros.extras import EXTRAS
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.runtime.registry import UNTRAINED
from dynssm_ros.signals import messages
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.signal_map import SIGNALS, load_signal_map
from dynssm_ros.vehicle import load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Declared = Callable[[str], dict[str, object]]
ROOT = Path(__file__).resolve().parent.parent
PAGES = {path.name: path.read_text(encoding="utf-8") for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]}
FOLDERS = {path.name: path.parent for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]}
USER_PAGES = {name: text for name, text in PAGES.items() if FOLDERS[name].name in ("start", "use", "understand")}
WORDS, WORDS_OF_A_PAGE = 20_360, 1_650  # of docs/, and of a page of it
RESULTS_FOLDER = ROOT / "benchmarks" / "results"  # in the words of the version that measured
RESULTS = {path.name: path.read_text(encoding="utf-8") for path in RESULTS_FOLDER.glob("*.md")}
README = PAGES["README.md"]


def table(head: str, text: str = README) -> dict[str, list[str]]:
    """The table of ``text`` whose first column is headed ``head``: cells by the code in the first cell."""
    lines = text.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(f"| {head} |"))
    rows = {}
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        first, *rest = (cell.strip() for cell in line.strip("|").split("|"))
        rows[first.strip("`")] = rest
    return rows


def test_every_command_is_described_and_every_described_one_exists() -> None:
    described = {name.removeprefix("dynssm ") for name in table("command")}
    registered = {command.callback.__name__ for command in app.registered_commands if command.callback}
    assert described == registered


def code_lines() -> Iterator[tuple[str, str]]:
    """Page and line of all code in blocks, with continued lines joined."""
    for name, text in PAGES.items():
        joined = re.sub(r"\\\n\s*", "", text)
        fenced = re.findall(r"^```(?:bash)?\n(.*?)^```", joined, flags=re.M | re.S)
        for line in [*re.findall(r"^(?: {4}|\t)(.*)", joined, flags=re.M), *"\n".join(fenced).splitlines()]:
            yield name, line.split("  #")[0].strip()


def options() -> dict[str, set[str]]:
    """Options by command."""
    group = typer.main.get_command(app)
    return {
        name: {
            option
            for parameter in (*group.params, *command.params)
            for option in (*parameter.opts, *parameter.secondary_opts)
        }
        for name, command in group.commands.items()  # type: ignore[attr-defined]
    }


def test_every_command_in_a_code_block_exists_with_its_options() -> None:
    known, seen = options(), set()
    for page, line in code_lines():
        for command, rest in re.findall(r"\bdynssm (\w+)((?: [^#|&;]*)?)", line):
            assert command in known, f"{page}: {line}"
            given = set(re.findall(r"(?<=\s)--[a-z-]+", rest))
            assert given <= known[command], f"{page}: {line}: {given - known[command]}"
            seen.add(command)
    assert seen >= set(known)


def test_every_option_that_a_page_names_exists() -> None:
    elsewhere = {"--help", "--ros-args", "--symlink-install", "--system-site-packages", "--backend", "--cpus"}
    known = set().union(*options().values()) | elsewhere
    for page, text in PAGES.items():
        named = set(re.findall(r"`(--[a-z-]+)", text))
        assert named <= known, f"{page}: {named - known}"


def test_every_module_that_a_code_block_runs_exists() -> None:
    outside = {"venv", "colcon", "doit"}
    for page, line in code_lines():
        for module in re.findall(r"python3? -m ([\w.]+)", line):
            assert module in outside or find_spec(module), f"{page}: {line}"
        for file in re.findall(r"doit (?:.* )?-f (\S+)", line):
            assert (ROOT / file).is_file(), f"{page}: {line}"


def test_every_node_parameter_in_a_code_block_is_declared(declared_parameters: Declared) -> None:
    seen = set()
    for page, line in code_lines():
        found = re.match(r"(?:ros2 run dynssm_ros )?(predictor|player|controller|simulator) --ros-args (.*)", line)
        if found:
            declared = set(declared_parameters(found[1])) | set(re.findall(r'"(\w+)"', node_source(found[1])))
            given = set(re.findall(r"-p (\w+):=", found[2]))
            assert given <= declared, f"{page}: {line}"
            seen.add(found[1])
    assert seen == {"predictor", "player", "controller", "simulator"}


def test_links_lead_somewhere() -> None:
    for page, text in PAGES.items():
        assert_links_lead_somewhere(page, text, FOLDERS[page])
    for page, text in RESULTS.items():
        assert_links_lead_somewhere(page, text, RESULTS_FOLDER)


def assert_links_lead_somewhere(page: str, text: str, folder: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#]+)(?:#([^)]*))?\)", text):
        if "://" in target:
            continue
        assert (folder / target).exists(), f"{page}: {target}"
        if anchor:
            assert anchor in anchors((folder / target).read_text(encoding="utf-8")), f"{page}: {target}#{anchor}"


def anchors(text: str) -> set[str]:
    """What links within a page lead to: its headings in lower case, with hyphens for spaces and without punctuation."""
    headings = re.findall(r"(?m)^#+ (.+)$", text)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_anchors_are_those_of_the_headings() -> None:
    assert anchors("# Suspect figures, of the `paper`\n\ntext #no\n## T_s: 0.5 s") == {
        "suspect-figures-of-the-paper", "t_s-05-s",
    }  # fmt: skip


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", str(tmp_path / "trees")]
    built = subprocess.run(
        [*command, str(ROOT / "docs"), str(tmp_path / "site")], capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    pages = {path.name for path in (tmp_path / "site").rglob("*.html")}
    assert pages >= {name.replace(".md", ".html") for name in PAGES if FOLDERS[name] != ROOT}


def test_the_readme_is_short_and_shows_a_picture() -> None:
    assert len(README.splitlines()) <= 90
    assert re.search(r"!\[.+\]\(docs/.+\.png\)", README)


def test_pages_for_users_are_short_and_begin_with_what_the_reader_can_do() -> None:
    count = {name: len(text.split()) for name, text in PAGES.items() if FOLDERS[name] != ROOT}
    assert sum(count.values()) <= WORDS
    assert max(count.values()) <= WORDS_OF_A_PAGE, count
    for name, text in USER_PAGES.items():
        assert re.match(r"# .+\n\nAfter this page ", text), name


def test_figures_that_pages_state_are_those_of_the_code() -> None:
    shipped = {kind: len(list((ROOT / "config" / kind).glob("*.yaml"))) for kind in ("vehicles", "models", "signals")}
    true = {"effects": len(EFFECTS), "commands": len(options()), "shipped vehicles": shipped["vehicles"],
            "shipped models": shipped["models"], "shipped signal maps": shipped["signals"]}  # fmt: skip
    for name, text in PAGES.items():
        for number, what in re.findall(r"\b(\d+) (effects|commands|shipped \w+(?: maps)?)\b", text):
            assert int(number) == true[what], f"{name}: {number} {what}"
    assert f"{len(EFFECTS)} effects" in PAGES["how_it_works.md"]
    minutes = [name for name, text in PAGES.items() if re.search(r"make test\b.*minutes", text)]
    assert minutes == ["CONTRIBUTING.md"]  # said once


def test_every_key_of_results_that_a_page_names_is_written() -> None:
    source = " ".join(path.read_text(encoding="utf-8") for path in (ROOT / "dynssm_ros").rglob("*.py"))
    named = [key for row in table("key in `results.json`", PAGES["diagnose.md"]) for key in re.findall(r"\w+", row)]
    assert len(named) > 8
    for key in named:
        assert f'"{key}":' in source, key


def test_python_in_the_pages_compiles_and_imports_what_there_is() -> None:
    blocks = [(page, block) for page, text in PAGES.items() for block in re.findall(r"```python\n(.*?)```", text, re.S)]
    assert blocks
    for page, block in blocks:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("dynssm_ros"):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    assert hasattr(module, alias.name), f"{page}: {node.module}.{alias.name}"


def test_the_example_of_the_api_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dynssm_ros.simulation.laps import write_run

    monkeypatch.chdir(tmp_path)
    write_run(dynssm_ros.simulate("orca", "club", duration=18.0, plant="euler", noise=(0.01, 0.01, 0.03)), "bag")
    (block,) = re.findall(r"```python\n(.*?)```", PAGES["api.md"], re.S)
    made: dict[str, object] = {}
    exec(compile(block, "api.md", "exec"), made)
    assert set(made["scored"].scores) == {"ridge", "single_track", "persistence"}  # type: ignore[attr-defined]
    assert (tmp_path / "car.yaml").is_file()


def test_every_equation_of_the_paper_is_where_the_page_says() -> None:
    named = set(re.findall(r"`((?:vehicle|signals|learning|runtime|control)\.[\w.]+)`", PAGES["paper.md"]))
    assert len(named) > 10
    for name in named:
        parts = name.split(".")
        modules = ["dynssm_ros." + ".".join(parts[: k + 1]) for k in range(len(parts))]
        deepest = max((m for m in modules if _is_module(m)), key=len)
        rest = ("dynssm_ros." + name).removeprefix(deepest).strip(".")
        reduce(getattr, filter(None, rest.split(".")), importlib.import_module(deepest))


def test_every_block_of_the_papers_results_is_somewhere() -> None:
    reference = yaml.safe_load((ROOT / "benchmarks" / "paper" / "reference.yaml").read_text(encoding="utf-8"))
    items = re.findall(r"^\| `(\w+)`:", PAGES["paper.md"], flags=re.M)
    assert set(items) == set(reference)
    shares = [*reference["claims"]["rmse"].values(), reference["claims"]["lap_time"]]
    for share in shares:
        assert f"{100 * share:.1f}" in PAGES["paper.md"]


@pytest.mark.parametrize("page", ["results.md", "results_race.md"])
def test_results_of_other_settings_are_marked_stale(page: str) -> None:
    """``python -m benchmarks.paper.stale benchmarks/results/results.md benchmarks/results/results_race.md`` mends it."""
    assert RESULTS[page] == marked(RESULTS[page], load_plan())


def test_the_rivals_settings_are_those_of_their_model_files() -> None:
    rows = table("setting", RESULTS["rivals.md"])
    assert {"ddm_av21", "ddm_orca", "fthd_av21", "fthd_orca"} <= {name.split(".")[0] for name in rows}
    for name, (published, ours, why) in rows.items():
        model, *path = name.split(".")
        assert float(ours) == reduce(getattr, path, load_model_config(model)), name
        assert published == ours or why, f"{name}: differs from what is published without a reason"
    named = set(table("model", RESULTS["rivals.md"]))
    assert named == {*UNTRAINED, "ridge", "rls", "gp", "on_track"}


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def said(module: Path) -> Iterator[str]:
    """The texts in a module but its docstrings, with what is filled in as in the source."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    silent = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = (each.value if isinstance(each, ast.Constant) else ast.unparse(each) for each in node.values)
            yield "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in silent:
            yield node.value


def test_every_verdict_is_explained_and_every_explained_one_exists() -> None:
    page, commands = PAGES["verdicts.md"], PAGES["troubleshooting.md"]
    source = "\n".join(words for path in (ROOT / "dynssm_ros").rglob("*.py") for words in said(path))
    verdicts = set(table("verdict", page))
    assert {refusal.value for refusal in Refusal} <= verdicts
    for words in [*verdicts, *re.findall(r"^\| `([^`]+)` \| [^|]+ \| [^|]+ \| [^|]+ \|$", page, flags=re.M)]:
        assert words in source, words
    for words in table("line contains", commands):
        assert words in source, words


def test_the_switches_that_pages_name_are_fields_of_model_files() -> None:
    fields = load_model_config("dynssm_paper_av21").model_dump()
    fields |= {name: block for name, block in load_model_config("dynssm").model_dump().items() if block is not None}
    named = [*table("block", PAGES["models.md"]), *(row[0] for row in table("deviation", PAGES["paper.md"]).values())]
    assert len(named) > 10
    for name in re.findall(r"[a-z_]+(?:\.[a-z_]+)?", " ".join(re.sub(r": \w+", "", each) for each in named)):
        block, _, field = name.partition(".")
        assert block in fields, name
        assert not field or field in fields[block], name


def test_the_extras_of_the_installation_page_are_those_of_the_package() -> None:
    assert set(table("extra", PAGES["installation.md"])) == {*EXTRAS, "(core)", "all"}


def test_the_vehicle_file_of_the_tutorial_is_one() -> None:
    car = load_vehicle(ROOT / "examples" / "racer_1_10.yaml")
    described = re.findall(r"\w+", " ".join(table("field", PAGES["my_car.md"])))
    coefficients = re.findall(r"\w+", " ".join(table("coefficient", PAGES["my_car.md"])))
    assert set(coefficients) == set(car.coefficients)
    assert {"m", "l_f", "l_r", "h_cg", "F_z0", "load_transfer", "sampling_time", "minimum_speed", "inputs"} <= set(
        described
    )
    assert car.sampling_time == 0.02


def node_source(node: str) -> str:
    return (ROOT / "dynssm_ros" / "nodes" / f"{node}.py").read_text(encoding="utf-8")


def as_ros_writes(declared: dict[str, Any]) -> dict[str, str]:
    """Values of parameters as they stand in tables."""
    return {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in declared.items()}


def test_the_parameters_of_the_predictor_are_those_of_its_page(declared_parameters: Declared) -> None:
    described = {name: cells[0].strip("`") for name, cells in table("parameter", PAGES["predictor.md"]).items()}
    assert described == as_ros_writes(declared_parameters("predictor"))


def test_the_parameters_of_the_controller_are_those_of_its_page(declared_parameters: Declared) -> None:
    described = {name: cells[0].strip("`") for name, cells in table("parameter", PAGES["controller.md"]).items()}
    declared = declared_parameters("controller")
    assert described == as_ros_writes(declared)


def test_the_topics_are_those_of_the_default_signal_map_and_of_the_node() -> None:
    topics = {cells[0].strip("`"): cells[1].strip("`") for cells in _topic_rows()}
    default = {source.recorded: source.type for source in load_signal_map("default").signals.values()}
    published = {messages.PREDICTION_TOPIC, messages.PARAMETERS_TOPIC, messages.HORIZON_TOPIC, messages.MARKERS_TOPIC}
    published |= {messages.CANDIDATE_TOPIC, messages.ROLLOUT_TOPIC}
    assert {topic: kind for topic, kind in topics.items() if topic in default} == default
    assert set(topics) == set(default) | published | {"/diagnostics", "/tf"}


def test_every_signal_and_shipped_file_is_named() -> None:
    text = " ".join(" ".join([*USER_PAGES.values(), RESULTS["rivals.md"]]).split())
    for name in SIGNALS:
        assert re.search(rf"\b{name}\b", text), name
    for kind in ("vehicles", "signals", "models"):
        for path in (ROOT / "config" / kind).glob("*.yaml"):
            assert re.search(rf"`{path.stem}[.`]", text), path.stem


@pytest.mark.parametrize("target", sorted(set(re.findall(r"^    make (\w+)", "\n".join(PAGES.values()), flags=re.M))))
def test_the_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.M)


def _topic_rows() -> list[list[str]]:
    lines = PAGES["predictor.md"].splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("| direction |"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            return rows
        rows.append([cell.strip() for cell in line.strip("|").split("|")][1:])
    return rows


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd")
def test_the_unit_is_one_that_systemd_knows(tmp_path: Path) -> None:
    unit = next(block for block in re.findall(r"(?:^    .*\n)+", PAGES["security.md"], re.M) if "[Service]" in block)
    (line,) = re.findall(r"^    (Environment=FASTDDS.*)$", PAGES["security.md"], re.M)
    file = tmp_path / "dynssm.service"
    text = re.sub("^    ", "", unit, flags=re.M) + line + "\n"
    file.write_text(text.replace("/opt/dynssm/bin/predictor", sys.executable).replace("User=racing", "User=root"))
    done = subprocess.run(["systemd-analyze", "verify", str(file)], capture_output=True, text=True, check=False)
    assert [words for words in done.stderr.splitlines() if file.name in words] == []
    assert "PrivateIPC" not in unit  # nodes must see the same /dev/shm


def test_the_effects_of_the_document_are_those_of_the_code() -> None:
    rows = [line for line in PAGES["effects.md"].splitlines() if "| `" in line]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    described = {name.strip("`"): (what, re.findall(r"`(\w+)`", how), advice) for name, what, how, advice in cells}
    assert described == {
        name: (effect.SUMMARY, list(effect.PARAMETERS), effect.ADVICE) for name, effect in EFFECTS.items()
    }
