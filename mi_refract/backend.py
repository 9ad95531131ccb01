"""Find the Mitsuba variants that run on this machine, and the libLLVM that they need.

Mitsuba's wheel does not contain libLLVM, and not every libLLVM works: Dr.Jit rejects LLVM 14, and LLVM 15 and 16 abort
the process (without an exception) in the first kernel that computes a minimum. So each library is first tried in a
separate process. The results "works", "crashes" and "too old" are stored in `$XDG_CACHE_HOME/mi_refract/backend.json`.
Any other error, such as too little memory, may pass, so the next process tries again.

Dr.Jit loads a libLLVM when it is imported, and no other one later. So call `activate` before Dr.Jit is imported; this
module needs only the standard library. Afterwards, a change of the library needs a new process, as started by
`activate(may_restart=True)`, which is for commands.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

from .io.safe_files import temporary_folder, write_atomically

CHOICE = "DRJIT_LIBLLVM_PATH"  # the library that Dr.Jit tries first
OWN_CHOICE = "MI_REFRACT_LIBLLVM"  # has the same value if this module, not the user, chose the library
WINDOWS = "LLVM-C.dll" if sys.platform == "win32" else ""  # file name of libLLVM on Windows
TIMEOUT = 120.0  # seconds; a probe takes 0.4 s of one idle core

# Prints "works" or fails with the reason in the last line. 67 numbers are full vectors and a remainder.
_PROBE = """
import ctypes, importlib, math, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
import drjit as dr

name = sys.argv[1]
if not dr.has_backend(getattr(dr.JitBackend, name.upper())):
    if name == "cuda":
        ctypes.CDLL("libcuda.so.1")
    sys.exit("refused")
arrays = importlib.import_module("drjit." + name)
for number in (arrays.Float32, arrays.Float64):
    x = dr.arange(number, 67) / 16
    y = dr.sqrt(dr.fma(dr.minimum(dr.maximum(x, 0.5), 3), x, 1))
    for i, y_i in enumerate(y):
        if not abs(y_i - math.sqrt(min(max(i / 16, 0.5), 3) * i / 16 + 1)) < 1e-5:
            sys.exit("a kernel computes wrong numbers")
if name == "cuda":
    import mitsuba as mi
    mi.set_variant("cuda_ad_rgb")
    scene = mi.load_dict({"type": "scene", "sphere": {"type": "sphere"}})
    if not abs(scene.ray_intersect(mi.Ray3f([0, 0, -3], [0, 0, 1])).t[0] - 2) < 1e-5:
        sys.exit("OptiX traces rays wrongly")
print("works")
"""


@dataclass(frozen=True)
class Backend:
    """One way to run Dr.Jit. `reason`: one line, why it is not usable, or what it runs on."""

    name: str  # "scalar", "llvm", "cuda"
    usable: bool
    reason: str
    library: str | None = None


@dataclass(frozen=True)
class Library:
    """A libLLVM and its defect, "" if it works."""

    path: str
    defect: str

    @property
    def works(self) -> bool:
        """Whether the library has no defect."""
        return not self.defect


def detect() -> dict[str, Backend]:
    """The backends scalar, llvm and cuda, and whether they run in this process. Never raises; cached per process."""
    return {"scalar": Backend("scalar", True, "always there"), "llvm": llvm(), "cuda": cuda()}


def usable_variants() -> dict[str, str | None]:
    """For each variant of the installed Mitsuba None if it runs here, else the reason in one line. Imports Mitsuba."""
    backends = detect()
    _set_library(backends["llvm"])
    import mitsuba as mi

    needed = {variant: backends[variant.partition("_")[0]] for variant in mi.variants()}
    return {variant: None if backend.usable else backend.reason for variant, backend in needed.items()}


def activate(preferred: str | None = None, *, may_restart: bool = False) -> str:
    """Set a Mitsuba variant that runs here, register this package's plugins in it, and return its name.

    The variant is `preferred`; by default llvm_ad_rgb if it runs here, else scalar_rgb. ValueError, in one line, for a
    variant that Mitsuba does not have or that cannot run here. `may_restart`: call `restart_if_needed` first.
    """
    if may_restart:
        restart_if_needed()
    cpu = llvm()
    _set_library(cpu)
    import mitsuba as mi

    import mi_refract  # noqa: F401  registers its plugins in every variant that is set afterwards

    if preferred is None:
        preferred = "llvm_ad_rgb" if cpu.usable else "scalar_rgb"
    elif preferred not in mi.variants():
        raise ValueError(f"variant {preferred!r}: unknown; expected {', '.join(_running())}")
    elif not preferred.startswith("scalar_") and (reason := usable_variants()[preferred]):
        raise ValueError(f"variant {preferred!r} cannot run here: {reason}; expected {', '.join(_running())}")
    # Mitsuba must search its own folder for plugins first, not load `plugins/sphere.so` of the working folder.
    own, resolver = str(Path(mi.__file__).parent), mi.file_resolver()  # type: ignore[operator]  # a class to its stubs
    if str(next(iter(resolver))) != own:
        resolver.prepend(own)
    mi.set_variant(preferred)
    return preferred


def _running() -> list[str]:
    return [variant for variant, reason in usable_variants().items() if reason is None]


def advice() -> str:
    """Why a group of variants does not run and what to install for it; one line."""
    missing = [f"the {b.name}_* variants are missing: {b.reason}" for b in detect().values() if not b.usable]
    return missing[0] if missing else "nothing is missing"


def summary() -> str:
    """The library that the CPU's variants run on; one line."""
    cpu = llvm()
    return f"llvm_* variants run on {cpu.reason}" if cpu.usable else f"only scalar_* variants run: {cpu.reason}"


# libLLVM -------------------------------------------------------------------------------------------------------


def libraries() -> list[Library]:
    """Every libLLVM on this machine with its defect, in the order of `candidates`; only the user's, if one is set."""
    chosen = _users_choice()
    return [_try(path) for path in ([chosen] if chosen else candidates())]


def candidates() -> list[str]:
    """The paths of every libLLVM on this machine, the highest version first; a library that is loaded comes first."""
    paths: list[str] = []
    ldconfig = shutil.which("ldconfig", path=os.pathsep.join([os.environ.get("PATH", ""), "/sbin", "/usr/sbin"]))
    if ldconfig:
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
        paths += re.findall(r"=> (\S*/libLLVM\S*)$", listing, re.MULTILINE)
    folders = [*os.environ.get("LD_LIBRARY_PATH", "").split(":"), f"{sys.prefix}/lib", "/usr/lib", "/usr/lib64"]
    folders += ["/usr/lib/*-linux-gnu", "/usr/lib/llvm*/lib*", "/usr/lib/llvm/*/lib*", "/usr/local/lib*"]
    folders += ["/usr/local/llvm*/lib*", "/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib"]
    for folder in folders:
        if folder.startswith("/"):
            paths += map(str, Path("/").glob(f"{folder[1:]}/libLLVM*"))
    if WINDOWS:  # Dr.Jit itself searches PATH
        paths += [str(x) for folder in os.environ["PATH"].split(os.pathsep) if (x := Path(folder, WINDOWS)).is_file()]
    loaded = _loaded() or set()
    versioned = []
    for path in set(map(os.path.realpath, paths)):
        version = _version(path)
        if version is not None:
            versioned.append((path in loaded, version, path))
    return [path for _, _, path in sorted(versioned, reverse=True)]


def _version(path: str) -> tuple[int, ...] | None:
    """The version in a file name: (19, 1) for libLLVM.so.19.1, (15,) for libLLVM-15.so.1; None if it is no libLLVM."""
    name = re.fullmatch(r"libLLVM(?:-(\d[\d.]*))?\.(?:so|dylib)(?:\.(\d[\d.]*))?", Path(path).name)
    if name is None:
        return () if Path(path).name == WINDOWS else None
    return tuple(int(part) for part in re.findall(r"\d+", name[1] or name[2] or ""))


def _title(path: str) -> str:
    version = _version(os.path.realpath(path))
    return f"libLLVM {'.'.join(map(str, version))}" if version else path


def _users_choice() -> str | None:
    chosen = os.environ.get(CHOICE)
    return chosen if chosen and chosen != os.environ.get(OWN_CHOICE) else None


@functools.cache
def llvm() -> Backend:
    """Dr.Jit on the CPU with the best libLLVM that works. `library` without `usable`: it needs a new process."""
    chosen = _users_choice()
    defects = []
    for path in [chosen] if chosen else candidates():
        library = _try(path)
        if library.works:
            loaded = _loaded() if "drjit" in sys.modules else None
            # The dynamic linker finds the folder of a path without one, so only its name can be compared.
            same = [os.path.realpath(path) == x if "/" in path else Path(x).name.startswith(path) for x in loaded or ()]
            if loaded is None or any(same):
                return Backend("llvm", True, _title(path), path)
            imported = ", ".join(sorted(map(_title, loaded))) or "no libLLVM"
            reason = f"Dr.Jit was imported with {imported}; start Python with {CHOICE}={path}"
            return Backend("llvm", False, reason, path)
        defects.append(f"{CHOICE}={path}: {library.defect}" if chosen else f"{_title(path)}: {library.defect}")
    install = "apt-get install libllvm19" if shutil.which("apt-get") else "install LLVM 17 or newer"
    remedy = f"expected the file of a libLLVM 17 or newer ({install})" if chosen else install
    return Backend("llvm", False, f"{'; '.join(defects) or 'no libLLVM found'}; {remedy}")


def _loaded() -> set[str] | None:
    """The libLLVM files loaded in this process; None if the system does not list them."""
    try:
        maps = Path("/proc/self/maps").read_text()
    except OSError:
        return None
    return {os.path.realpath(path) for path in re.findall(r"(/.*)$", maps, re.MULTILINE) if _version(path) is not None}


def _set_library(backend: Backend) -> None:
    """Set the library that Dr.Jit will load, unless Dr.Jit is imported already or the user chose one."""
    if backend.usable and backend.library and "drjit" not in sys.modules and not _users_choice():
        os.environ[CHOICE] = os.environ[OWN_CHOICE] = backend.library


def restart_if_needed() -> None:
    """For commands: make Dr.Jit use the libLLVM that works.

    If Dr.Jit was imported with another one already, run this process's command line again, and do not return.
    """
    cpu = llvm()
    _set_library(cpu)
    # If the library was set already and Dr.Jit did not load it, continue without it.
    if cpu.usable or cpu.library is None or os.environ.get(CHOICE) == cpu.library:
        return
    os.environ[CHOICE] = os.environ[OWN_CHOICE] = cpu.library
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


# Probes --------------------------------------------------------------------------------------------------------


@functools.cache
def cuda() -> Backend:
    """Dr.Jit on an NVIDIA GPU, and Mitsuba's ray tracing on it. Not stored in the file, as drivers change."""
    defect, _ = _probe("cuda", {})
    return Backend("cuda", not defect, defect or "NVIDIA driver and OptiX")


def _try(path: str) -> Library:
    """Try one libLLVM, or return the stored result if the file, Dr.Jit and the CPU have not changed."""
    try:
        state = Path(path).stat()
    except OSError as error:
        if "/" in path:
            return Library(path, (error.strerror or "cannot be read").lower())
        state = None
    # The stored defects by key; a missing or invalid file counts as empty.
    try:
        stored = json.loads(_cache_file().read_text())
    except (OSError, ValueError, RuntimeError):
        stored = None
    stored = {key: x for key, x in stored.items() if isinstance(x, str)} if isinstance(stored, dict) else {}
    # The result depends on the library, on Dr.Jit, on the CPU's instruction sets, and on the probe itself.
    try:
        drjit = importlib.metadata.version("drjit")
    except importlib.metadata.PackageNotFoundError:
        drjit = "unknown"
    try:
        flags = re.search(r"^(?:flags|Features)\s*:.*$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        flags = None
    machine = f"drjit {drjit}, {zlib.crc32((_PROBE + (flags[0] if flags else '')).encode()):08x}"
    key = state and f"{os.path.realpath(path)}, {state.st_mtime_ns}, {state.st_size}, {machine}"
    if key in stored:
        return Library(path, stored[key])
    defect, lasting = _probe("llvm", {CHOICE: path})
    if key and lasting:
        stored[key] = defect
        with contextlib.suppress(OSError, RuntimeError):  # then the next process tries the library again
            _cache_file().parent.mkdir(parents=True, exist_ok=True)
            write_atomically(_cache_file(), json.dumps(dict(list(stored.items())[-50:]), indent=1))
    return Library(path, defect)


def _probe(name: str, environment: dict[str, str]) -> tuple[str, bool]:
    """(defect, lasting) of a backend, tried in a separate process. A lasting result would occur again."""
    command = [sys.executable, "-c", _PROBE, name]
    try:
        with temporary_folder() as folder:
            # With an empty kernel cache, so that the kernels are compiled.
            own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "DRJIT_CACHE_DIR": str(folder)}
            result = subprocess.run(
                command,
                env=os.environ | own | environment,
                cwd=folder,
                timeout=TIMEOUT,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
            )
    except subprocess.TimeoutExpired:
        return f"a tiny kernel took longer than {TIMEOUT:.0f} s", False
    except OSError as error:
        return f"no process could be started: {error.strerror}", False
    if result.returncode < 0:
        no_memory = re.search("out of memory|bad_alloc|annot allocate", result.stderr)
        lasting = not no_memory and result.returncode not in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT)
        name = {s.value: s.name for s in signal.Signals}.get(-result.returncode, f"signal {-result.returncode}")
        return f"ends the process in Dr.Jit's kernels ({name})", lasting
    if result.returncode == 0 and result.stdout.endswith("works\n"):
        return "", True
    # Report Dr.Jit's own message if it rejected the library, else the last line.
    lines = [line.strip() for line in result.stderr.splitlines() if line.strip()] or ["no answer"]
    if "libcuda.so.1: cannot open" in lines[-1]:
        return "no NVIDIA driver: libcuda.so.1 not found", False
    if lines[-1] != "refused":
        return lines[-1][:200], False
    # "jit_find_library(): Unable to load "x": x: invalid ELF header!", "jit_llvm_init(): ... too old. The Dr.Jit ..."
    message = next((line for line in lines[:-1] if name in line or name == "llvm"), "no message")
    message = re.sub(r'^(\w+\(\): )?(Unable to load "[^"]*": [^:]*: )?', "", message)
    return f"refused by Dr.Jit: {message.split('. ')[0].rstrip('.! ')[:200]}", "too old" in message


# Stored results ------------------------------------------------------------------------------------------------


def _cache_file() -> Path:
    """The file of stored results. RuntimeError if the user has no home directory."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "mi_refract" / "backend.json"
