"""Arithmetic on processors as CUDA's compiler may do it: x·y + z with one rounding."""

import drjit as dr
import pytest


@pytest.fixture
def fused(vectorised, monkeypatch):
    """The `vectorised` setting, where sums of products become `dr.fma` and Dr.Jit's arrays claim to be CUDA's.

    Operations inside a call of Dr.Jit's, such as `dr.dot`, do not change.
    """
    if vectorised.backend != "llvm":
        pytest.skip("on CUDA the compiler itself fuses")
    backend_v = dr.backend_v
    monkeypatch.setattr(dr, "backend_v", lambda x: dr.JitBackend.CUDA if dr.is_jit_v(x) else backend_v(x))
    for vector in (vectorised.vector, dr.float64_array_t(vectorised.vector)):
        _fuse(vector, monkeypatch)
    return vectorised


def _fuse(vector, monkeypatch):
    number = dr.value_t(vector)
    products = {}  # (product, factors) by the index of the product, which is kept alive
    times, plus, minus, negative = number.__mul__, number.__add__, number.__sub__, number.__neg__

    def factors(x):
        return products.get(x.index, (None, None))[1] if isinstance(x, number) else None

    def multiply(x, y):
        product = times(x, y)
        if isinstance(product, number):
            products[product.index] = product, (number(x), number(y))
        return product

    def add(x, y):
        if pair := factors(x):
            return dr.fma(*pair, y)
        pair = factors(y)
        return dr.fma(*pair, x) if pair else plus(x, y)

    def subtract(x, y):
        if pair := factors(x):
            return dr.fma(*pair, -y)
        pair = factors(y)
        return dr.fma(negative(pair[0]), pair[1], x) if pair else minus(x, y)

    def componentwise(operation):
        def by_component(u, v):
            return vector(*(operation(x, v[i] if isinstance(v, vector) else v) for i, x in enumerate(u)))

        return by_component

    for name, operation in {"mul": multiply, "rmul": multiply, "add": add, "radd": add, "sub": subtract}.items():
        monkeypatch.setattr(number, f"__{name}__", operation)
        monkeypatch.setattr(vector, f"__{name}__", componentwise(operation))
