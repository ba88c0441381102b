"""Independent reference mathematics: closed forms that share no code with what they judge.

Joint distributions of whole records, exact enumeration, Riccati equations and symbolic identities
in NumPy, SciPy, SymPy and python-control; CasADi never appears. Importing the package costs NumPy
alone.
"""

from fkgen.oracle.exact.batch import BatchResult, Joint, batch_lmmse, joint_distribution
from fkgen.oracle.exact.compression import (
    CompressionResult,
    Policy,
    accepted_rows,
    batch_compression,
)
from fkgen.oracle.exact.enumeration import EnumerationResult, enumerate_jumps, enumerate_modes
from fkgen.oracle.exact.hypotheses import MultipleModelResult, batch_posterior, textbook_mme
from fkgen.oracle.exact.moments import FaultMoments, satisfies_lemma_2
from fkgen.oracle.exact.partial_compression import (
    PartialCompression,
    PartialCompressionResult,
    partial_compression,
)
from fkgen.oracle.exact.paths import JumpResult, enumerate_paths
from fkgen.oracle.exact.uncertain import batch_uncertain, joint_moments
from fkgen.oracle.plants.actuator import LinearSystem, draw_gamma, simulate
from fkgen.oracle.plants.jump import JumpRecord, JumpSystem, simulate_jumps
from fkgen.oracle.plants.sensor import (
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
from fkgen.oracle.sampled import draw_record, informed
from fkgen.oracle.textbook.compression import PrintedCompression
from fkgen.oracle.textbook.fault_effect import Gains, after_pulse, after_step, gains, within_step
from fkgen.oracle.textbook.jump import SteadyState, composite, stationary_jumps, textbook_jumps
from fkgen.oracle.textbook.linear_optimal import (
    LinearOptimalResult,
    linear_optimal,
    true_covariance,
)
from fkgen.oracle.textbook.loss_tests import LossTest
from fkgen.oracle.textbook.mkf import TextbookStep, log_likelihood, textbook_step
from fkgen.oracle.textbook.riccati import (
    constant_input_noise,
    stationary_prediction,
    stationary_prediction_by_control,
)
from fkgen.oracle.textbook.switching import (
    InteractingResult,
    Lumping,
    OneStepResult,
    interacting,
    silent_lumped,
    textbook_imm,
    textbook_one_step,
)
from fkgen.oracle.theorems.compression import COMPRESSION_IDENTITIES
from fkgen.oracle.theorems.linear_optimal import LINEAR_IDENTITIES
from fkgen.oracle.theorems.mkf import IDENTITIES, Identity
from fkgen.oracle.theorems.partial_compression import PARTIAL_IDENTITIES

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
