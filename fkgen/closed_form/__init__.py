"""Independent reference mathematics: closed forms that share no code with what they judge.

Joint distributions of whole records, exact enumeration, Riccati equations and symbolic identities
in NumPy, SciPy, SymPy and python-control; CasADi never appears. Importing the package costs NumPy
alone.
"""

from fkgen.closed_form.batch import BatchResult, Joint, batch_lmmse, joint_distribution
from fkgen.closed_form.hypotheses import MultipleModelResult, batch_posterior, textbook_mme
from fkgen.closed_form.identities import IDENTITIES, Identity
from fkgen.closed_form.riccati import (
    constant_input_noise,
    stationary_prediction,
    stationary_prediction_by_control,
)
from fkgen.closed_form.system import LinearSystem, draw_gamma, simulate
from fkgen.closed_form.textbook import TextbookStep, log_likelihood, textbook_step

__all__ = [
    "IDENTITIES",
    "BatchResult",
    "Identity",
    "Joint",
    "LinearSystem",
    "MultipleModelResult",
    "TextbookStep",
    "batch_lmmse",
    "batch_posterior",
    "constant_input_noise",
    "draw_gamma",
    "joint_distribution",
    "log_likelihood",
    "simulate",
    "stationary_prediction",
    "stationary_prediction_by_control",
    "textbook_mme",
    "textbook_step",
]
