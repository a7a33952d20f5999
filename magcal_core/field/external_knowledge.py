"""What is known of the external field in a session: how wrong the reference may be, and whether there was a storm.

Notes
-----
One shape does not do as an error: 1 nT of a uniform field along the dipole moves the common scale factor by 33 ppm in
an orbit of 10 deg inclination and by -7 ppm in one of 98 deg, 1 nT of the induced dipole by 30 to 33 ppm everywhere. So
three sources are considered, each at one standard deviation: the ring current with what it induces, the induced part
alone, and a uniform field. Their sizes hold 1.96 times the scale error in 94 to 100 % of the sessions, measured against
the magnetosphere of CHAOS-7 [CHAOS]_.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Mask, Nanoseconds
from magcal_core.field import FieldModel
from magcal_core.field.choices import EXTERNAL_KINDS
from magcal_core.field.external import (
    GAIN,
    MEAN_EXTERNAL_NT,
    UNIFORM_NT,
    ExternalField,
    shapes,
)
from magcal_core.field.hourly import HourlyIndex
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.sources import FieldSources
from magcal_core.field.summed import SummedField

RING_INDUCED: Final = 0.27
"""What the ring current induces, as a share of it."""
STORM_NT: Final = 100.0
"""External field that the reference lacks, nT rms, from which a calibration is weak: 0.4 % of the scale at worst."""
STORM_WARNING_NT: Final = 60.0
STORM_KP: Final = 7.0
"""The same where only Kp is known: RC is -187 nT in the mean there."""
MOST_HOURS: Final = 500
"""Hours of an index that a record keeps for its figure."""
QUIET_KP: Final = 2.0
QUIET_CHANGE_NT: Final = 4.0


@dataclass(frozen=True, slots=True)
class Sizes:
    """One standard deviation of each considered source, nT."""

    ring: float
    induced: float
    uniform: float


UNKNOWN: Final = Sizes(17.0, 2.5, 23.0)
"""Where nothing of the external field is taken away."""
MEAN: Final = Sizes(17.0, 2.5, 3.0)
"""Where its mean is."""


@dataclass(frozen=True, slots=True, eq=False)
class ConsideredError:
    """One source of error of the reference: its vector at each sample at one standard deviation, (n, 3), ITRF, nT."""

    source: str
    why: str
    error_nt: Floats


@dataclass(frozen=True, slots=True)
class Storm:
    """That the reference lacks, or may lack, much external field; ``is_weak``: enough to weaken the verdict."""

    text: str
    is_weak: bool


@dataclass(frozen=True, slots=True)
class ExternalKnowledge:
    """The external field of a session as far as it is known.

    Attributes
    ----------
    used : ExternalField, optional
        The part of the field model; None where it has none.
    beside : tuple of HourlyIndex
        Indices that are available and not in use, the better one first.
    sources : FieldSources
    model : str
        Name of the field model.
    """

    used: ExternalField | None
    beside: tuple[HourlyIndex, ...]
    sources: FieldSources
    model: str

    @classmethod
    def of(cls, field: FieldModel, sources: FieldSources | None = None) -> ExternalKnowledge:
        """Return what a model and the available ``sources`` say."""
        at_hand = FieldSources() if sources is None else sources
        used = field.external if isinstance(field, SummedField) else None
        is_driven = used is not None and used.index is not None
        names = () if is_driven else tuple(name for name in EXTERNAL_KINDS.values() if name is not None)
        found = [at_hand.hourly(name) for name in names]
        return cls(used, tuple(one for one in found if one is not None), at_hand, field.name)

    @property
    def kind(self) -> str:
        """What the model takes: ``none``, ``mean``, ``dst`` or ``rc``."""
        return "none" if self.used is None else self.used.kind

    def index(self, stamps_ns: Nanoseconds) -> HourlyIndex | None:
        """Return the hourly index of a session with samples at ``stamps_ns``: the one in use, or an available one."""
        if self.used is not None and self.used.index is not None:
            return self.used.index
        return next((one for one in self.beside if (one.hours(stamps_ns) >= 0).any()), None)

    # --------------------------------------------------------------------------------------------------- errors

    def sizes(self, stamps_ns: Nanoseconds) -> tuple[Sizes, str]:
        """Return the standard deviations over a session where its index is known, and what they were taken from."""
        index = self.index(stamps_ns)
        if index is None:
            return (UNKNOWN, "no index") if self.used is None else (MEAN, "the mean of years, no index")
        parts_nt = index.parts_at(stamps_ns)
        known = parts_nt[~np.isnan(parts_nt[:, 0])]
        if self.used is None or self.used.index is None:
            base, away_nt = (UNKNOWN, 0.0) if self.used is None else (MEAN, MEAN_EXTERNAL_NT)
            ring = float(np.sqrt(np.mean((known[:, 0] - away_nt) ** 2)))
            return Sizes(ring, base.induced, base.uniform), f"{index.name} is available and not in use"
        largest = float(np.abs(known.sum(axis=1)).max()) if len(known) else 0.0
        why = f"{index.name} to {largest:.0f} nT"
        if self.used.kind == "dst":
            return Sizes(float(np.hypot(3.0, 0.1 * largest)), float(np.hypot(2.0, 0.02 * largest)), 6.0), why
        hours = index.used_hours(stamps_ns)
        has_parts = bool(index.has_parts[hours].all())
        return Sizes(0.1 * largest, 1.0 if has_parts else 1.5, 2.0), why

    def errors(self, session_ns: Nanoseconds, stamps_ns: Nanoseconds, r_itrf_km: Floats) -> tuple[ConsideredError, ...]:
        """Return the three considered sources at ``stamps_ns`` and ``r_itrf_km``, some of the samples of a session."""
        sizes, why = self.sizes(session_ns)
        uniform, induced = shapes(stamps_ns, r_itrf_km)
        # A sample at which the mean stands for the index has the mean's errors.
        is_mean = np.zeros(len(stamps_ns), np.bool_)
        if self.used is not None and self.used.index is not None:
            is_mean = ~self.used.is_known(stamps_ns)
        made = []
        for name, shape in (("ring", uniform + RING_INDUCED * induced), ("induced", induced), ("uniform", uniform)):
            size_nt = getattr(sizes, name)
            per_sample = np.where(is_mean, getattr(MEAN, name), size_nt)
            words = f"{size_nt:.3g} nT ({why})"
            made.append(ConsideredError(f"external_{name}", words, per_sample[:, None] * shape))
        return tuple(made)

    def storm(self, stamps_ns: Nanoseconds, r_itrf_km: Floats) -> Storm | None:
        """Return the storm that the reference knows nothing of, or not enough; None on other days."""
        index = self.index(stamps_ns)
        if index is None:
            kp = self.sources.kp_at(stamps_ns)[0]
            largest = float(np.nanmax(kp)) if np.isfinite(kp).any() else 0.0
            if largest >= STORM_KP:
                text = f"Kp reached {largest:g}, limit {STORM_KP:g}: RC is -187 nT in the mean then; give an index RC"
                return Storm(text, is_weak=True)
            return None
        size_nt = self.sizes(stamps_ns)[0].ring
        text = f"the external field may be wrong by {size_nt:.0f} nT"
        lacking_nt = self._lacking_nt(index, stamps_ns, r_itrf_km)
        if lacking_nt >= size_nt:
            cure = {"RC": "rc", "Dst": "dst"}[index.name]
            size_nt, text = lacking_nt, f"the reference lacks {lacking_nt:.0f} nT rms of external field; +{cure} has it"
        if size_nt < STORM_WARNING_NT:
            return None
        return Storm(f"{text}, limit {STORM_NT:g} nT", is_weak=size_nt >= STORM_NT)

    def _lacking_nt(self, index: HourlyIndex, stamps_ns: Nanoseconds, r_itrf_km: Floats) -> float:
        """Return the rms, nT, of the external field that the index tells of and the reference does not have."""
        if self.used is not None and self.used.index is not None:
            return 0.0
        b_nt = _field_nt(index.parts_at(stamps_ns), stamps_ns, r_itrf_km)
        if self.used is not None:
            b_nt = b_nt - _mean_nt(stamps_ns, r_itrf_km)
        squares = np.einsum("ij,ij->i", b_nt, b_nt)
        known = squares[np.isfinite(squares)]
        return float(np.sqrt(known.mean())) if len(known) else 0.0

    # --------------------------------------------------------------------------------------------------- record

    def not_quiet(self, stamps_ns: Nanoseconds) -> Mask:
        """Return which samples are not known to be of a quiet hour, shape (n,): Kp above 2, or a change above 4 nT.

        Raises
        ------
        IndexMissingError
            There is no Kp, or no hourly index.
        """
        index = self.used.index if self.used is not None and self.used.index is not None else None
        if index is None:
            index = self.index(stamps_ns) or next(iter(self.beside), None)
        if index is None:
            self.sources.require_hourly("RC", "quiet_only: beside Kp it")
        self.sources.require_kp("quiet_only")
        kp = self.sources.kp_at(stamps_ns)[0]
        change_nt = np.full(len(stamps_ns), np.nan) if index is None else index.changes_nt(stamps_ns)
        return ~((kp <= QUIET_KP) & (change_nt <= QUIET_CHANGE_NT))

    def to_dict(self, stamps_ns: Nanoseconds, r_itrf_km: Floats) -> dict[str, object]:
        """Return ``external_field`` of the record, over the samples of a session."""
        index = self.index(stamps_ns)
        used, rms_nt, bridged, by_mean = self.used, None, 0, 0
        if used is not None:
            b_nt = np.zeros_like(r_itrf_km)
            used.add_to(b_nt, stamps_ns, np.ascontiguousarray(r_itrf_km))
            rms_nt = float(np.sqrt(np.mean(np.einsum("ij,ij->i", b_nt, b_nt)))) if len(b_nt) else None
            if used.index is not None:
                by_mean = int(np.count_nonzero(~used.is_known(stamps_ns)))
                bridged = int(np.count_nonzero(used.index.source[used.index.used_hours(stamps_ns)] < 0))
        return {
            "kind": self.kind,
            "index_nt": None if index is None else _spread(index.parts_at(stamps_ns).sum(axis=1)),
            "rms_nt": rms_nt,
            "interpolated_hours": bridged,
            "mean_samples": by_mean,
        }

    def series(self, stamps_ns: Nanoseconds) -> dict[str, object] | None:
        """Return the hourly index about a session, for a figure: name, middles of hours and values; None without one.

        At most `MOST_HOURS` hours, evenly thinned.
        """
        index = self.index(stamps_ns)
        if index is None or not len(hours := index.used_hours(stamps_ns)):
            return None
        hours = hours[:: -(-len(hours) // MOST_HOURS)]
        middles = (index.start_ns + hours * HOUR_NS + HOUR_NS // 2).view("datetime64[ns]")
        return {
            "name": index.name,
            "time": [f"{text}Z" for text in np.datetime_as_string(middles, unit="s")],
            "index_nt": index.total_nt[hours].tolist(),
        }

    def provenance(self, stamps_ns: Nanoseconds, *, is_quiet_only: bool) -> list[dict[str, object]]:
        """Return which files of indices the session used, and how many hours of each."""
        found: list[dict[str, object]] = []
        index = self.index(stamps_ns)
        if index is not None:
            sources = index.source[index.used_hours(stamps_ns)]
            found += _entries(enumerate(index.files), {int(s): int((sources == s).sum()) for s in np.unique(sources)})
        if is_quiet_only or index is None:
            which = self.sources.kp_at(stamps_ns)[1]
            hours = {int(s): len(np.unique(stamps_ns[which == s] // HOUR_NS)) for s in np.unique(which)}
            found += _entries(enumerate(self.sources.kp()), hours)
        return found


def _entries(files: Iterable[tuple[int, Index]], hours: Mapping[int, int]) -> list[dict[str, object]]:
    return [
        {
            "name": index.name,
            "format": index.format,
            "sha256": index.sha256,
            "first": f"{np.datetime_as_string(index.first_utc, unit='us')}Z",
            "last": f"{np.datetime_as_string(index.last_utc, unit='us')}Z",
            "hours": hours[number],
        }
        for number, index in files
        if hours.get(number)
    ]


def _spread(index_nt: Floats) -> dict[str, float] | None:
    known = index_nt[np.isfinite(index_nt)]
    if not len(known):
        return None
    return {"mean": float(known.mean()), "min": float(known.min()), "max": float(known.max())}


def _field_nt(parts_nt: Floats, stamps_ns: Nanoseconds, r_itrf_km: Floats) -> Floats:
    """Return the external field by the parts of an index, shape (n, 2), nT, at any radius: shape (n, 3), ITRF, nT."""
    uniform, induced = shapes(stamps_ns, r_itrf_km)
    strength = GAIN * parts_nt - np.array([UNIFORM_NT, 0.0])
    return np.asarray(strength[:, :1] * uniform + strength[:, 1:] * induced)


def _mean_nt(stamps_ns: Nanoseconds, r_itrf_km: Floats) -> Floats:
    parts_nt = np.tile([MEAN_EXTERNAL_NT, 0.0], (len(stamps_ns), 1))
    return _field_nt(parts_nt, stamps_ns, r_itrf_km)
