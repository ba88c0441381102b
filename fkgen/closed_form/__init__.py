"""Independent reference mathematics: closed forms that share no code with what they judge.

Joint distributions of whole records, exact enumeration, Riccati equations and symbolic identities
in NumPy, SciPy, SymPy and python-control; CasADi never appears. Importing the package costs NumPy
alone.
"""

from fkgen.closed_form.batch import BatchResult, Joint, batch_lmmse, joint_distribution
from fkgen.closed_form.compression import (
    CompressionResult,
    Policy,
    accepted_rows,
    batch_compression,
)
from fkgen.closed_form.compression_identities import COMPRESSION_IDENTITIES
from fkgen.closed_form.draw import draw_record, informed
from fkgen.closed_form.enumeration import EnumerationResult, enumerate_jumps, enumerate_modes
from fkgen.closed_form.fault_moments import FaultMoments, satisfies_lemma_2
from fkgen.closed_form.hypotheses import MultipleModelResult, batch_posterior, textbook_mme
from fkgen.closed_form.identities import IDENTITIES, Identity
from fkgen.closed_form.interacting import (
    InteractingResult,
    Lumping,
    interacting,
    silent_lumped,
    textbook_imm,
)
from fkgen.closed_form.jump import JumpRecord, JumpSystem, simulate_jumps
from fkgen.closed_form.jump_paths import JumpResult, enumerate_paths
from fkgen.closed_form.jump_stationary import stationary_jumps
from fkgen.closed_form.jump_textbook import SteadyState, composite, textbook_jumps
from fkgen.closed_form.linear_optimal import (
    LinearOptimalResult,
    linear_optimal,
    true_covariance,
)
from fkgen.closed_form.loss_tests import LossTest
from fkgen.closed_form.orthogonality import LINEAR_IDENTITIES
from fkgen.closed_form.partial_compression import (
    PartialCompression,
    PartialCompressionResult,
    partial_compression,
)
from fkgen.closed_form.partial_identities import PARTIAL_IDENTITIES
from fkgen.closed_form.printed_compression import PrintedCompression
from fkgen.closed_form.propagation import Gains, after_pulse, after_step, gains, within_step
from fkgen.closed_form.riccati import (
    constant_input_noise,
    stationary_prediction,
    stationary_prediction_by_control,
)
from fkgen.closed_form.sensor import (
    SensorLaw,
    aggregate,
    draw_modes,
    gamma_delta,
    is_lumpable,
    mode_plant,
    nominal_share,
    sensed_modes,
    simulate_sensor,
)
from fkgen.closed_form.switching import OneStepResult, textbook_one_step
from fkgen.closed_form.system import LinearSystem, draw_gamma, simulate
from fkgen.closed_form.textbook import TextbookStep, log_likelihood, textbook_step
from fkgen.closed_form.uncertain import batch_uncertain, joint_moments

__all__ = [
    "COMPRESSION_IDENTITIES",
    "IDENTITIES",
    "LINEAR_IDENTITIES",
    "PARTIAL_IDENTITIES",
    "BatchResult",
    "CompressionResult",
    "EnumerationResult",
    "FaultMoments",
    "Gains",
    "Identity",
    "InteractingResult",
    "Joint",
    "JumpRecord",
    "JumpResult",
    "JumpSystem",
    "LinearOptimalResult",
    "LinearSystem",
    "LossTest",
    "Lumping",
    "MultipleModelResult",
    "OneStepResult",
    "PartialCompression",
    "PartialCompressionResult",
    "Policy",
    "PrintedCompression",
    "SensorLaw",
    "SteadyState",
    "TextbookStep",
    "accepted_rows",
    "after_pulse",
    "after_step",
    "aggregate",
    "batch_compression",
    "batch_lmmse",
    "batch_posterior",
    "batch_uncertain",
    "composite",
    "constant_input_noise",
    "draw_gamma",
    "draw_modes",
    "draw_record",
    "enumerate_jumps",
    "enumerate_modes",
    "enumerate_paths",
    "gains",
    "gamma_delta",
    "informed",
    "interacting",
    "is_lumpable",
    "joint_distribution",
    "joint_moments",
    "linear_optimal",
    "log_likelihood",
    "mode_plant",
    "nominal_share",
    "partial_compression",
    "satisfies_lemma_2",
    "sensed_modes",
    "silent_lumped",
    "simulate",
    "simulate_jumps",
    "simulate_sensor",
    "stationary_jumps",
    "stationary_prediction",
    "stationary_prediction_by_control",
    "textbook_imm",
    "textbook_jumps",
    "textbook_mme",
    "textbook_one_step",
    "textbook_step",
    "true_covariance",
    "within_step",
]
