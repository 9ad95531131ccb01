"""The largest error that a formula may have, as an a-priori bound for every single ray, for numbers and numpy arrays.

With u the roundoff, K = max(1, k) for a transmitted ray and 1 for a reflected one, D = cos²θ_t the exact radicand:

    |b/|a| − exact| ≤ linear u K + ρ(x, D),   x = radicand u K^growth,   ρ(x, D) = min(√x, x / (√D + √max(D − x, 0)))

because the terms linear in rounded quantities have an error of a few u of the largest one, k, and because
|√(D + e) − √D| = |e| / (√(D + e) + √D) ≤ ρ(x, D) for |e| ≤ x. For |D| > x, the decision is right.

If a formula computes n·a with an error of `side` u, it may treat a ray that is within that distance of the surface as
tangential, or as coming from the other side, which moves b by a further 2 cosθ_t. The bound allows both.
"""

from __future__ import annotations

from dataclasses import dataclass

from mi_refract.numerics import Values


@dataclass(frozen=True)
class Budget:
    """The constants of the bound above; K = 1 where `growth` is 0.

    Arguments of the methods: `u` roundoff, `k` = n_from / n_to, `cos_t`, `cos_i` absolute cosines, `transmitted` and
    `unit` (whether |a| = 1) masks; each a number or a numpy array (N,). Results have the shape of all of them together.

    `any_length`: `linear` for |a| ≠ 1; None for a formula that takes unit vectors only.
    """

    linear: float
    radicand: float = 0.0
    growth: int = 0
    any_length: float | None = None
    side: float = 0.0

    @property
    def at_the_limit(self) -> bool:
        """Whether the bound allows no more than the rounding of the exact answer, for vectors of any length."""
        return self.any_length is not None

    def chord(
        self,
        u: Values,
        k: Values,
        cos_t: Values = 0.0,
        transmitted: Values = True,
        unit: Values = True,
        cos_i: Values = 1.0,
    ) -> Values:
        """Bound of the chord error |b/|a| − exact|. The defaults stand for the critical angle, where it is largest."""
        import numpy as np

        bound = self.of_terms(u, k, transmitted, unit) + self.of_root(u, k, cos_t, transmitted)
        return bound + np.where(self.side_open(u, cos_i), 2 * cos_t, 0.0)

    def side_open(self, u: Values, cos_i: Values) -> Values:
        """Whether n·a is within its error, `side` u, of 0; False if `side` is 0."""
        return (cos_i <= self.side * u) & (self.side > 0)

    def of_terms(self, u: Values, k: Values, transmitted: Values = True, unit: Values = True) -> Values:
        """The part of the bound that is linear in u: `linear` u K."""
        import numpy as np

        linear = np.where(unit, self.linear, self.any_length or self.linear)
        return linear * u * np.where(transmitted & (self.growth > 0), np.maximum(1.0, k), 1.0)

    def of_root(self, u: Values, k: Values, cos_t: Values, transmitted: Values = True) -> Values:
        """The part of the bound due to the radicand's error under the root; 0 under total internal reflection."""
        import numpy as np

        return np.where(transmitted, root(self.radicand_error_bound(u, k), cos_t), 0.0)

    def radicand_error_bound(self, u: Values, k: Values) -> Values:
        """Bound of the error of the radicand. If |1 − k² sin²θ| exceeds it, the decision is right."""
        import numpy as np

        return self.radicand * u * np.maximum(1.0, k) ** self.growth


def root(x: Values, cos_t: Values) -> Values:
    """ρ(x, cos²θ_t): the error of √ if its argument has the error x ≥ 0. Numbers or arrays (N,); ρ(x, 0) = √x."""
    import numpy as np

    rest = np.sqrt(np.maximum(cos_t * cos_t - x, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.fmin(np.sqrt(x), x / (cos_t + rest))


def radicand_for(error: Values, cos_t: Values) -> Values:
    """The x with ρ(x, cos²θ_t) = `error` ≥ 0, the inverse of `root`. Numbers or arrays (N,)."""
    import numpy as np

    return np.where(error <= cos_t, error * (2 * cos_t - error), error * error)


# Rounding the exact answer has an error of at most √3/2 u if no component exceeds 1: half an ulp of each. The bound
# allows 0.0064u more for the steps before. For other lengths half an ulp is up to u of a component: √Σ(u bᵢ)² = u |b|.
# Where the radicand is below 2⁻⁴⁴ of its terms, the promoted form can have 0.6u more; no tested ray exceeds the bound.
ROUNDING = Budget(0.8724, any_length=1.005)
# In u: |a| = 1 up to the rounding of its components, which changes a length by no more than this.
UNIT = 3**0.5 / 2
# In u² of the radicand's terms: for a radicand below this, the decision moves b by less than its root, u, so both
# decisions are right. The forms need 0.32u² (promoted, in float32) and 500u³.
NEGLIGIBLE = 1.0
# In u: the error of n·a of unit vectors, from three products and two sums.
SIDE = 4.0


def cancelling(growth: int) -> Budget:
    """The budget of a form with the radicand 1 − k² sin²θ, or a² − k² sin²θ; its error grows like k^`growth`.

    With kw ≤ 1 and dot products by fused multiply-adds, for sin²θ = w² = |n×a|²: 2 k²w δw ≤ 2uk (1 + w), w·w 3u, k² and
    its product 2u, the first term 3u if it is a·a, the lengths of n and a 4u, the difference u: together at most 14uK.
    For sin²θ = 1 − (n·a)²: 2c δc ≤ 6u, inputs 4u, c² u, all times k², and 3u: 14uK². Linear terms: 10u, from six
    roundings and the 2c/n² of the mirror direction.
    """
    return Budget(10, 14, growth, side=SIDE)


# (n·a)² − κ w²: at the critical angle c² = 1 − 1/k² has an error of 2c (2 + c) u + c² u, and κ w² one of
# 2κw (1 + w) u + 3κw² u + u. Their sum is 6.7uK at k = 1.5, 7.3uK at k = 2.5, 4.8uK at k = 5. Both terms scale alike
# with |a| and |n|.
CONTRASTING = Budget(10, 8, 1, side=SIDE)

# The backward error of `decomposed` (see `mi_refract.accuracy.backward_error`) due to rounding, in u, for k up to 2.5.
# With c = cos θ_i, e = k sin θ_i, q = k c − √R: the error of the radicand R = 1 − k² (1 − c²) is
# ΔR = k² (6c + 5c² + sin² θ_i) + 2e² + 1, including the vectors' lengths; that of the linear terms is k + |q| + 1 + e.
# So the backward errors are
#   directions  (k + |q| + 1 + e + e (ΔR/2 + 2√R (k c + |q| + 1))) / (k c + |q| + e)   7.8 at most
#   decisions   ΔR / (2 (2k c + 1)), at e = 1                                          5.8
#   lengths     (ΔR + 2 (k + |q| + 1 + e)) / (4 (2k + 1))                              3.4
TEXTBOOK_BACKWARD = 8.0  # the largest backward error of `decomposed` due to rounding, in u, for k up to 2.5
