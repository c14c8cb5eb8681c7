import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
API = ROOT / "tests" / "typing" / "api.py"


def test_user_code_passes_the_strict_type_checker(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path), str(API)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280)
    assert done.stdout == "Success: no issues found in 1 source file\n", done.stdout + done.stderr


def test_the_package_says_that_it_is_typed() -> None:
    assert (ROOT / "fls_flow" / "py.typed").is_file()


def test_that_code_is_what_a_graph_can_use() -> None:
    script = "import api; print([kind.role for kind in api.kinds() if kind.listing is None])"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=API.parent, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.strip() == "['filter', 'detector', 'source', 'sink']", done.stderr
