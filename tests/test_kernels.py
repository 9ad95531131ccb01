"""How long kernels are: operations by Dr.Jit's own record."""

import drjit as dr
import numpy as np
import pytest

from mi_refract import fresnel


def test_the_powers_of_the_plugin_are_a_short_kernel(vectorised):
    """Operations of the kernel that turns (a, b, mask, k, κ) into R and T; the κ/d² form it replaced had 53. A division
    takes as long as eight others, and there is one."""
    if vectorised.name != "float32":
        pytest.skip("the plugin's precision is float32")
    number = dr.value_t(vectorised.vector)
    x = [number(np.linspace(0.1, 0.9, 64)) for _ in range(6)]
    transmitted = x[0] > 0.2
    dr.eval(x, transmitted)
    a, b = vectorised.vector(x[0], x[1], x[2]), vectorised.vector(x[0], x[1], x[3])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(fresnel.local_powers(a, b, transmitted, x[4], x[5]))
        assert max(entry.get("operation_count", 0) for entry in dr.kernel_history()) <= 47
