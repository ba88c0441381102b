"""What the partial compression filter loses beside a filter that loses nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fkgen.closed_form import LinearSystem, partial_compression
from fkgen.families.partial_evidence import design_of
from fkgen.study.examinations.figures import Array, Figures
from fkgen.study.examinations.findings import Finding, Part

#: Windows beyond which nobody waits for a figure.
_LONGEST = 500

#: A variance that is so much larger is worth a word.
_MUCH = 0.1


def compression_loss(figures: Figures) -> Part:
    """Variance after the first window over that of a Kalman filter, all rows at every sample."""
    spec, soft = figures.spec, figures.spec.faults.soft
    if spec.filter.family != "cpcf" or soft is None or soft.window > _LONGEST:
        return Part()
    system = LinearSystem.from_spec(spec, soft.window + 1)
    design = replace(design_of(spec, soft.window), false_alarm=None)
    y, u = np.zeros((system.length, system.ny)), np.zeros((system.length, system.nu))
    compressed = np.diag(partial_compression(system, design, y, u).filtered_covariance[-1])
    kalman = np.diag(_filtered(system))
    ratio = np.divide(compressed, kalman, out=np.ones_like(kalman), where=kalman > 0.0)
    worst = int(np.argmax(ratio))
    loss = float(ratio[worst]) - 1.0
    values = {"compression_loss": loss}
    if loss <= _MUCH:
        return Part((), values)
    message = (
        f"the variance of {spec.model.states[worst].name} after the first window is {loss:.0%}"
        " above that of dfcf, which loses nothing (all rows at every sample)"
    )
    remedy = 'family = "dfcf", or a shorter window'
    if spec.filter.maintenance == "paper":
        remedy = f'maintenance = "optimal", {remedy}'
    return Part((Finding("compression_loss", "warning", message, loss, remedy),), values)


def _filtered(system: LinearSystem) -> Array:
    """Covariance of a Kalman filter of all rows after the last sample, in Joseph's form."""
    P = system.P0
    for k in range(system.length):
        if k:
            P = system.A[k - 1] @ P @ system.A[k - 1].T + system.Q[k - 1]
        C, R = system.C[k], system.R[k]
        K = P @ C.T @ np.linalg.pinv(C @ P @ C.T + R, hermitian=True)
        rest = np.eye(system.nx) - K @ C
        P = rest @ P @ rest.T + K @ R @ K.T
    return np.asarray(P)
