"""How long kernels are: operations by Dr.Jit's own record."""

import drjit as dr
import numpy as np
import pytest

from mi_refract.formulas import fresnel


def test_the_powers_of_the_plugin_are_a_short_kernel(vectorised):
    """Operations of the kernel that turns (a, mask, k, κ) into R and T, the root of cos θ_t included."""
    if vectorised.name != "float32":
        pytest.skip("the plugin's precision is float32")
    number = dr.value_t(vectorised.vector)
    x = [number(np.linspace(0.1, 0.9, 64)) for _ in range(5)]
    transmitted = x[0] > 0.2
    dr.eval(x, transmitted)
    a = vectorised.vector(x[0], x[1], x[2])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(fresnel.local_powers(a, transmitted, x[3], x[4]))
        assert max(entry.get("operation_count", 0) for entry in dr.kernel_history()) <= 45
