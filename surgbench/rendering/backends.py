"""Which of Mitsuba's differentiable variants this machine can run, asked in processes of their own.

Dr.Jit loads any LLVM from 15 on, but 15 and 16 kill the process at the first gradient ("Cannot select: f32 =
fmaximum"): the version has to be known before a variant is chosen.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache

OLDEST_LLVM = 17
INSTALL_LLVM = "on Debian and Ubuntu: apt-get install libllvm19"

_ASK_LLVM = "import drjit; print('LLVM', *drjit.detail.llvm_version())"
# That there is a GPU is not enough: rays also need OptiX, which comes with the driver but not into every container.
_TRY_CUDA = """
import drjit
if not drjit.has_backend(drjit.JitBackend.CUDA):
    raise SystemExit("no GPU that Dr.Jit can use")
import mitsuba
mitsuba.set_variant("cuda_ad_rgb")
scene = mitsuba.load_dict({"type": "scene", "shape": {"type": "sphere"}})
ray = mitsuba.Ray3f(mitsuba.Point3f(0, 0, -5), mitsuba.Vector3f(0, 0, 1))
print("CUDA", bool(scene.ray_test(ray)[0]))
"""


@cache
def llvm_version() -> tuple[int, ...] | None:
    """The version of the LLVM that Dr.Jit finds (``DRJIT_LIBLLVM_PATH`` or the system's); ``None`` if it finds none."""
    words = _run(_ASK_LLVM)[0].split()
    version = tuple(int(word) for word in words[1:]) if words[:1] == ["LLVM"] else (-1,)
    return version if version[0] >= 0 else None


def llvm_problem() -> str | None:
    """Why the LLVM variants cannot be used, in one line with what would help; ``None`` where they can."""
    version = llvm_version()
    if version is not None and version[0] >= OLDEST_LLVM:
        return None
    found = "none that loads" if version is None else ".".join(map(str, version))
    return f"needs LLVM {OLDEST_LLVM} or later, found {found}; {INSTALL_LLVM}"


@cache
def cuda_problem() -> str | None:
    """Why the CUDA variants cannot be used, in one line; ``None`` where they can."""
    answer, error = _run(_TRY_CUDA)
    return None if answer == "CUDA True" else error


def _run(script: str) -> tuple[str, str]:
    """Last lines of what a Python script prints and of what it complains about."""
    try:
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    except subprocess.TimeoutExpired:
        return "", "no answer within 120 s"
    if done.returncode < 0:
        return "", f"killed by signal {-done.returncode}"
    answer, error = (text.strip().splitlines()[-1:] for text in (done.stdout, done.stderr))
    return "".join(answer) if done.returncode == 0 else "", "".join(error) or "no answer"
