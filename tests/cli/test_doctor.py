"""`mi-refract doctor`: what runs here, and what is missing."""

from __future__ import annotations

import json

import mitsuba as mi
from support.processes import python

import mi_refract
from mi_refract import backend
from mi_refract.cli import app


def test_doctor(capfd):
    assert app.main(["doctor"]) == 0
    out, _ = capfd.readouterr()
    assert all(variant in out for variant in mi.variants())
    assert mi.__version__ in out
    capfd.readouterr()
    assert app.main(["doctor", "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert facts["variants"] == backend.usable_variants()
    assert facts["libllvm"] == {library.path: library.defect or "works" for library in backend.libraries()}
    assert facts["versions"]["mi_refract"] == mi_refract.__version__
    assert out.rstrip().endswith(facts["advice"])


def test_doctor_without_llvm():
    environment = {backend.CHOICE: "/nonexistent", backend.OWN_CHOICE: ""}
    with python("import sys; from mi_refract.cli import main; sys.exit(main(['doctor']))", **environment) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    advice = out.splitlines()[-1]
    assert advice.startswith("the llvm_* variants are missing: DRJIT_LIBLLVM_PATH=/nonexistent: no such file")
    assert "apt-get install libllvm19" in advice or "LLVM 17" in advice
    assert "Traceback" not in err


def test_doctor_where_nothing_runs(monkeypatch, capfd):
    monkeypatch.setattr(backend, "usable_variants", lambda: {"scalar_rgb": "made up"})
    assert app.main(["doctor"]) == 2
    assert capfd.readouterr().err == "mi-refract: no Mitsuba variant can run on this machine\n"
