"""Constitutive laws and damping as immutable values (device side in kernels/elements/materials.py)."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from .base.checks import float_array, is_number, number_hint
from .base.errors import ModelError
from .base.names import check_choice, did_you_mean
from .base.renamed import check_members
from .base.short_repr import use_short_repr

__all__ = ["SVK", "KelvinVoigt", "Material", "MooneyRivlin", "NeoHookean"]

DAMPING_FORMS = ("incremental", "rate", "explicit")
"""Evaluation of the damping force within a step."""

Density = float | np.ndarray | Callable[[np.ndarray], np.ndarray] | None


ADMISSIBLE_VALUES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "nu": (lambda v: (v > -1.0) & (v < 0.5), "between -1 and 0.5, both excluded"),
    **dict.fromkeys(("E", "mu", "mu10", "k"), (lambda v: v > 0.0, "positive, Pa")),
    "mu01": (lambda v: v >= 0.0, "0 or above, Pa"),
    **dict.fromkeys(("eta", "lambda_v"), (lambda v: v >= 0.0, "0 or above, Pa s")),
    "density": (lambda v: v > 0.0, "positive, kg/m^3"),
    "density_factor": (lambda v: v > 0.0, "positive"),
}
"""Admissible finite values of a constant, and the text for others."""
DENSITY_CONSTANTS = ("density", "density_factor")
"""Constants of the mass: the density if it is one number, else a factor on the given one."""


def _check_constants(owner: str, **values: Any) -> None:
    """ModelError for a constant outside its range."""
    for name, value in values.items():
        if name == "nu":
            good, text = is_number(value) and -1.0 < value < 0.5, "lie between -1 and 0.5, both excluded"
        elif name in ("mu01", "eta", "lambda_v"):
            good, text = is_number(value) and value >= 0.0, "be a finite number that is not negative"
        else:
            good, text = is_number(value) and value > 0.0, "be a positive finite number"
        if not good:
            raise ModelError(f"{owner}: {name} = {value!r} must {text}{number_hint(value)}")


def _check_density(owner: str, density: Density) -> None:
    if density is None or callable(density):
        return
    values = float_array(density)
    if values.ndim > 1 or not np.all(np.isfinite(values)) or not np.all(values > 0.0):
        raise ModelError(
            f"{owner}: density = {density!r} must be positive (kg/m^3): a number, one per element, or f(X)"
            f"{number_hint(density)}"
        )


@dataclass(frozen=True)
class KelvinVoigt:
    """Finite-strain Kelvin-Voigt damping, S_vis = 2 eta Edot + lambda_v tr(Edot) I (Eq. 62).

    Args:
        eta: shear viscosity, Pa s.
        lambda_v: bulk-like viscosity, Pa s.
        form: discretisation of Edot. "incremental" (default): the difference of E over the step; vanishes for any
            rigid rotation and has a potential. "rate": Eq. (58) with F and Fdot at the end of the step, as Paper I; a
            spinning body expands. "explicit": Eq. (58) at the start of the step, a force held during it.

    Raises:
        ModelError: a negative or non-finite viscosity, or an unknown form.
    """

    eta: float
    lambda_v: float = 0.0
    form: str = "incremental"

    def __post_init__(self) -> None:
        _check_constants("KelvinVoigt", eta=self.eta, lambda_v=self.lambda_v)
        check_choice("KelvinVoigt: form", self.form, DAMPING_FORMS)


@dataclass(frozen=True, eq=False, repr=False)
class Material:
    """Base of the laws: density (optional in statics without gravity) and optional damping.

    `constant_names`: constants that may differ between worlds; `coefficients` follows from them by operations valid for
    arrays. `_given_constants`: E and nu of a law made by `from_E_nu`, with its other arguments in `_options`.
    """

    law: ClassVar[str]
    constant_names: ClassVar[tuple[str, ...]] = ()
    _given_constants: ClassVar[dict[str, Any]] = {}
    _options: ClassVar[dict[str, Any]] = {}
    density: Any = field(default=None, kw_only=True)
    damping: KelvinVoigt | None = field(default=None, kw_only=True)

    __repr__ = use_short_repr

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse members by former names, see base/renamed.py."""
        super().__init_subclass__(**options)
        check_members(cls, Material)

    def __new__(cls, *values: Any, **options: Any) -> Self:
        """ModelError for unknown arguments of a law; suggests from_E_nu if E or nu is given."""
        taken = inspect.signature(cls.__init__).parameters
        if hasattr(cls, "from_E_nu") and not {"E", "nu"} & set(taken) and {"E", "nu"} & set(options):
            name = cls.__name__
            raise ModelError(f"{name}: E and nu are not its constants; {name}.from_E_nu(E=, nu=) takes them")
        kinds = [parameter.kind for parameter in taken.values()]
        known = list(taken)[1:]
        row = known[: kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) - 1]
        odd = [name for name in options if name not in known and inspect.Parameter.VAR_KEYWORD not in kinds]
        if odd or (len(values) > len(row) and inspect.Parameter.VAR_POSITIONAL not in kinds):
            what, hint = f"{len(values)} values without names, such as density=, are too many", ""
            if odd:
                what, hint = f"{odd[0]!r} is unknown", did_you_mean(odd[0], known)
            raise ModelError(f"{cls.__name__}: {what}; it takes {', '.join(known)}{hint}")
        return super().__new__(cls)

    def _check(self) -> None:
        """ModelError for constants, density or damping out of range."""
        owner = type(self).__name__
        _check_constants(owner, **{name: getattr(self, name) for name in self.constant_names})
        _check_density(owner, self.density)
        if self.damping is not None and not isinstance(self.damping, KelvinVoigt):
            raise ModelError(f"{owner}: damping = {self.damping!r} must be a KelvinVoigt(eta, lambda_v), or None")

    @property
    def constants(self) -> dict[str, float]:
        """Constants of the law and of the damping by name; a law made by `from_E_nu` has E and nu in place of its
        own.
        """
        out = self._given_constants or {name: getattr(self, name) for name in self.constant_names}
        out = out | ({"eta": self.damping.eta, "lambda_v": self.damping.lambda_v} if self.damping else {})
        if self.density is None:
            return out
        number = not callable(self.density) and np.ndim(self.density) == 0
        return out | ({"density": float(self.density)} if number else {"density_factor": 1.0})

    def with_constants(self, values: Mapping[str, Any]) -> Self:
        """Copy of the material with other `constants`, unchecked; arrays hold one value per world."""
        out = object.__new__(type(self))  # no look at the signature, as for arguments of users
        vars(out).update(vars(self))
        if "density" in values:
            vars(out)["density"] = values["density"]
        rates = {name: values[name] for name in ("eta", "lambda_v") if name in values}
        if rates:
            damping = copy.copy(self.damping)
            vars(damping).update(rates)
            vars(out)["damping"] = damping
        mine = {name: value for name, value in values.items() if name not in {*rates, *DENSITY_CONSTANTS}}
        if self._given_constants:
            vars(out)["_given_constants"] = self._given_constants | mine
            mine = self._constants_from_E_nu(**out._given_constants, **self._options)
        vars(out).update(mine)
        return out

    @classmethod
    def _create_from_E_nu(
        cls, E: float, nu: float, *, density: Any, damping: KelvinVoigt | None, **options: float
    ) -> Self:
        """Material from E and nu at rest, which it stores."""
        _check_constants(cls.__name__, E=E, nu=nu)
        out = cls(**cls._constants_from_E_nu(E, nu, **options), density=density, damping=damping)
        vars(out).update(_given_constants={"E": E, "nu": nu}, _options=options)
        return out

    @staticmethod
    def _constants_from_E_nu(E: Any, nu: Any, **options: float) -> dict[str, Any]:
        """A law's own constants."""
        raise NotImplementedError

    def coefficients(self) -> tuple[float, float, float]:
        """Device coefficients of the law."""
        raise NotImplementedError

    @property
    def lame(self) -> tuple[float, float]:
        """Lame constants (lambda, mu) at rest, Pa."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class SVK(Material):
    """St. Venant-Kirchhoff: Psi = lambda/2 tr(E)^2 + mu tr(E^2), Eqs. (25)-(28).

    For large rotations and small to moderate strains. It softens in compression: the uniaxial stress decreases below
    a stretch of 1/sqrt(3) = 0.577 of the length and vanishes under full compression; a mirrored element
    (F = diag(-1, 1, 1)) has zero strain. Use a neo-Hookean law in such cases; each step reports min J.

    Args:
        E: Young's modulus, Pa.
        nu: Poisson's ratio, -1 < nu < 0.5.
        density: kg/m^3 of the reference configuration; a number, one per element, or f(X (n, 3)) -> (n,). There is no
            default: motion, gravity, body forces and the mass matrix need one; statics without gravity does not.
        damping: KelvinVoigt or None.

    Raises:
        ModelError: a parameter out of range.
    """

    E: float
    nu: float
    law: ClassVar[str] = "svk"
    constant_names: ClassVar[tuple[str, ...]] = ("E", "nu")

    def __post_init__(self) -> None:
        self._check()

    @classmethod
    def from_E_nu(cls, *, E: float, nu: float, density: Any = None, damping: KelvinVoigt | None = None) -> SVK:
        """Equivalent to the constructor; every law has it."""
        return cls(E=E, nu=nu, density=density, damping=damping)

    @property
    def lame(self) -> tuple[float, float]:
        return lame_constants(self.E, self.nu)

    def coefficients(self) -> tuple[float, float, float]:
        lam, mu = self.lame
        return lam, mu, 0.0


@dataclass(frozen=True, eq=False, repr=False)
class MooneyRivlin(Material):
    """Mooney-Rivlin: Psi = mu10 (I1bar - 3) + mu01 (I2bar - 3) + k/2 (J - 1)^2, Eqs. (36)-(52).

    Defined for J > 0 only: a step that reaches J <= 0 at a quadrature point or vertex is refused.

    Args:
        mu10, mu01: shear coefficients, Pa; mu01 = 0 is neo-Hookean. Their sum must be positive.
        k: bulk modulus, Pa.
        density, damping: as for SVK.

    Raises:
        ModelError: a parameter out of range.
    """

    mu10: float
    mu01: float
    k: float
    law: ClassVar[str] = "mooney_rivlin"
    constant_names: ClassVar[tuple[str, ...]] = ("mu10", "mu01", "k")

    def __post_init__(self) -> None:
        self._check()

    @classmethod
    def from_E_nu(
        cls, *, E: float, nu: float, density: Any = None, damping: KelvinVoigt | None = None, ratio: float = 0.25
    ) -> MooneyRivlin:
        """From Young's modulus and Poisson's ratio at rest; `ratio` = mu01 / (mu10 + mu01)."""
        if not 0.0 <= ratio < 1.0:
            raise ModelError(f"MooneyRivlin: ratio = {ratio!r} must lie in [0, 1)")
        return cls._create_from_E_nu(E, nu, ratio=ratio, density=density, damping=damping)

    @staticmethod
    def _constants_from_E_nu(E: Any, nu: Any, **options: float) -> dict[str, Any]:
        ratio, half = options["ratio"], E / (4.0 * (1.0 + nu))
        return {"mu10": half * (1 - ratio), "mu01": half * ratio, "k": E / (3.0 * (1.0 - 2.0 * nu))}

    @property
    def lame(self) -> tuple[float, float]:
        mu = 2.0 * (self.mu10 + self.mu01)
        return self.k - 2.0 * mu / 3.0, mu

    def coefficients(self) -> tuple[float, float, float]:
        return self.mu10, self.k, self.mu01


@dataclass(frozen=True, eq=False, repr=False)
class NeoHookean(Material):
    """Neo-Hookean: Psi = mu/2 (I1bar - 3) + k/2 (J - 1)^2, which is Mooney-Rivlin with mu01 = 0.

    Args:
        mu: shear modulus, Pa.
        k: bulk modulus, Pa.
        density, damping: as for SVK.

    Raises:
        ModelError: a parameter out of range.
    """

    mu: float
    k: float
    law: ClassVar[str] = "neo_hookean"
    constant_names: ClassVar[tuple[str, ...]] = ("mu", "k")

    def __post_init__(self) -> None:
        self._check()

    @classmethod
    def from_E_nu(cls, *, E: float, nu: float, density: Any = None, damping: KelvinVoigt | None = None) -> NeoHookean:
        """From Young's modulus and Poisson's ratio at rest."""
        return cls._create_from_E_nu(E, nu, density=density, damping=damping)

    @staticmethod
    def _constants_from_E_nu(E: Any, nu: Any, **options: float) -> dict[str, Any]:
        return {"mu": E / (2.0 * (1.0 + nu)), "k": E / (3.0 * (1.0 - 2.0 * nu))}

    @property
    def lame(self) -> tuple[float, float]:
        return self.k - 2.0 * self.mu / 3.0, self.mu

    def coefficients(self) -> tuple[float, float, float]:
        return 0.5 * self.mu, self.k, 0.0


def lame_constants(E: float, nu: float) -> tuple[float, float]:
    """Lame constants (lambda, mu), Pa."""
    return E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), E / (2.0 * (1.0 + nu))
