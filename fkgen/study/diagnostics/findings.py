"""What a check can say: the texts of all findings."""

from __future__ import annotations

import re
from typing import cast

from fkgen.problem.finding import Severity

#: "severity code: message -> remedy"; what follows a dot tells findings of one code apart.
_TEXTS = """
note unstable_plant: the plant is unstable: |eigenvalue| {value:.6g}, so left alone an error doubles
    in {doubling:.3g} samples -> right if the real plant is so
warning unobservable: unobservable: rank {rank} of {n}; the measurements say nothing about {names},
    whose error only dies away on its own -> measure it, or leave it out of the model
error undetectable: not detectable: rank {rank} of {n}; the measurements say nothing about {names},
    and its error does not die away (|eigenvalue| {radius:.6g})
    -> measure it, or leave it out of the model
warning not_stabilisable: no process noise reaches {names}, which does not die away either: its
    gain tends to 0 and the filter ends up ignoring its measurements
    -> give it some process noise, unless it is a constant to be learnt once
warning no_stationary_filter: the filter does not come to rest: the Riccati equation has no
    stabilising solution -> see what is said about detectability and process noise
note time_constant: an error of the estimate decays with a time constant of {value:.3g}
    samples{seconds}
warning time_constant.slow: an error of the estimate decays with a time constant of {value:.3g}
    samples{seconds} -> more process noise makes it quicker
note stationary_sd: standard deviation of the filtered state at rest, {which}: {deviations}
warning silent_output: {name} says nothing: its row of C is zero -> leave it out, or mend C
warning idle_state: nothing drives {name}: its rows of A, B and Q are zero, so it is 0 after one
    step -> leave it out, or mend A
note decoupled: the state falls into parts that nothing couples: without covariances between them
    a step takes {value} operations in place of {whole} -> code.decoupled = true, unless priors are
    to couple them
note error_decay: {decays}
note error_decay_unknown: the gains of {family} depend on the measurements or on the law of their
    faults: no condition on its products of gains is known; the figures are those of the Kalman
    filter without faults
note error_decay_unproved: {reason}: then it is only certain that the effect, measured by P(k|k),
    never grows once the fault is over (condition e); that every rho(M[k]) < 1 would prove nothing
    more -> see fault-effect, over parameters and inputs that occur

note stationary_sd.trajectory: standard deviation of the filtered state in the second half of {of}:
    {deviations}
warning trajectory_refused: the filter refuses {value} of {samples} samples of {of}, the first is
    sample {first}: they are left out -> see the status of run at that sample
warning unobservable.trajectory: unobservable along {of}: over {length} samples from any of its
    {windows} windows on the measurements{whom} say nothing about {names}
    -> measure it, leave it out of the model, or drive the plant in another way (--record, --u)
note unobservable.sometimes: unobservable in {k} of {windows} windows of {length} samples of {of},
    which begin at samples {starts}: there the measurements{whom} say nothing about {names}
note unobservable.mode: unobservable in mode{plural} {modes} along {of}: over {length} samples from
    any of its {windows} windows on the measurements of that mode say nothing about {names}, those
    of another do
note weakly_observable: no window of {length} samples of {of} determines {name} as well as the prior
    does: sd {value:.3g} from measurements alone, {prior:.3g} from P0
note nonlinearity: second-order terms along {of}: of h up to {h} deviations of the noise, of f up to
    {f} of the prediction; {enough} is enough
warning nonlinearity.anew: second-order terms along {of}: of h up to {h} deviations of the noise,
    of f up to {f} of the prediction: {family} believes its first estimates too much; over the
    spread of the filtered state they are {h_after} -> family = "{enough}", or a smaller P0
warning nonlinearity.spread: second-order terms along {of}: of h up to {h} deviations of the noise,
    of f up to {f} of the prediction: too many for {family} -> family = "{enough}", which takes them
    in, or less uncertainty; fkgen compare says what is left
warning nonlinearity.faults: second-order terms along {of}: of h up to {h} deviations of the noise,
    of f up to {f} of the prediction: too many for {family}, which linearises as ekf does
    -> a smaller P0, or more noise in R; fkgen compare says what it does to errors
warning nonlinearity.none: second-order terms along {of}: of h up to {h} deviations of the noise, of
    f up to {f} of the prediction: what is not linear is most of the error, which no Gaussian
    describes -> a smaller P0, or trials: fkgen compare says what each filter makes of it
error no_value: {key} has no value for {name} within a deviation or two of the estimate at sample
    {value} of {of} -> functions that are defined there (max, if), or a smaller P0
warning not_affine: {key} is not affine in inputs that fail: {family} takes it at their mean, which
    is off by up to {where} deviations -> inputs that enter linearly: functions of them as inputs
note not_affine.little: {key} is not affine in inputs that fail: {family} takes it at their mean,
    which is off by up to {where} deviations
warning integration: {integrator} with substeps = {substeps} is off by {value:.2g} deviations of the
    prediction in a sample -> substeps = {count}

note unseen_bias: a lasting bias of {name} cannot be seen: the estimate takes all of it in, and only
    its first samples show in the innovation (from {least} on, GLR of one sample)
    -> a second sensor of the same, if that matters
note unseen_biases: lasting biases of {names} together ({how}) cannot be seen: the estimate takes
    them in -> a sensor that does not share their cause, if they can share one
warning unseen_input: a fault of the input {name} cannot be seen: it reaches no measurement, but it
    may reach the state -> measure something that it drives

warning innovation_rank: the innovation covariance has rank {value} of {rows}{where}: some rows of y
    follow exactly from the others, and are left out by a decision on rank
    -> give every measurement some noise, at least that of its last digit
warning noise_free_output: {names} without noise: taken as exact, whatever happens
    -> a quantised signal has the variance step**2 / 12
warning noise_free_output.combined: R is singular: {value} combination(s) of the measurements
    without noise -> a quantised signal has the variance step**2 / 12
note conditioning: prior to noise variance is {shown}; the {form} form of the covariance update is
    used{loss}
warning conditioning.lost: prior to noise variance is {value:.2g}: the short form of the covariance
    update loses that many digits, and {scalar} has no more
    -> code.update = "auto" or "joseph", or a smaller P0
error conditioning.severe: prior to noise variance is {value:.2g}: the short form of the covariance
    update loses that many digits, and {scalar} has no more
    -> code.update = "auto" or "joseph", or a smaller P0
warning rounding: process noise of {names} is lost in {scalar}: Q is below the rounding of P
    -> {remedy}more process noise
error float_range: {letter} holds {value:.3g}, which float cannot
    -> other units, or scalar = "double"
note float_suitable: {bound}
note float_rounding: {bound}
    -> for float: states of a smaller range, such as offsets from a reference
note start: from the prior on, float stays within {value:.2g} sd of double over {samples} samples;
    {name} is the worst, at sample {at}
warning start.off: from the prior on, float is {value:.2g} sd off double in {name} at sample {at} of
    {samples} -> scalar = "double", or a smaller P0
error start.lost: from the prior on, float is {value:.3g} sd off double in {name} at sample {at} of
    {samples}: it is another estimate -> scalar = "double", or a smaller P0
error start.negative: from the prior on, {value} of {samples} samples in float have a variance below
    zero, the first is sample {first} -> scalar = "double", or a smaller P0
error start.refused: from the prior on, float refuses {value} of {samples} samples that double
    takes, the first is sample {first}: a covariance lost its positivity
    -> scalar = "double", or a smaller P0
error start.unfit: no code can be generated: with these numbers, in {scalar}, {what} -> {remedy}
warning float_rounding.used: {bound}
    -> scalar = "double", or states of a smaller range, such as offsets from a reference

note certain_rate: success rate {value:g}: nothing is random; the filter is a Kalman filter {with_}
    that input
note certain_rate.hypothesis: hypothesis {rates} is certain: a plain Kalman filter for that input
note no_feedthrough: D = 0: y[k] does not show the fault of sample k, which acts as process noise
    B N B'
note no_feedthrough.bank: D = 0: mixture and Gaussian likelihood are the same
warning same_hypotheses: hypotheses {names} are the same: their probabilities never part -> drop one
note mirrored_hypotheses: hypotheses {names} have the same covariances: only the mean, rate times u,
    tells them apart
warning dead_hypothesis: hypothesis {rates} has prior 0 and no floor: it never comes into play
    -> a prior above 0, or a weight_floor
error unidentifiable: the inputs never reach y: no measurement tells one hypothesis from another
    -> measure something that the inputs drive
note needs_input: while u = 0 the probabilities do not move: identification needs inputs
warning gaussian_likelihood: {value} independent inputs, at most {most} for the mixture likelihood:
    the Gaussian is used, which is overconfident at first
    -> say likelihood = "gaussian" if that is meant
warning slow_identification: D = 0: the rate shows only through the state, so the hypotheses part
    slowly; that they never do, as the paper has it, is not so -> measure the input behind the fault
note no_weight_floor: weight_floor = 0, as in the paper: a probability that has gone does not
    return, so a change of the rate is not followed -> the default 1e-6 follows changes
warning high_weight_floor: the floors under {count} hypotheses add up to {value:.3g}: the
    probabilities cannot settle -> a weight_floor near 1e-6
warning noise_factor: noise_factor = {value:g} is below 1: the fault delta = C makes the sensor
    better -> state R of the better condition, and a factor above 1
note impossible_mode: the modes {names} never come: their probability is exactly zero
    -> another initial, or a kernel that leads there, if they can happen
note no_memory: the rows of the kernel are equal: imm gives what one_step gives, at more cost
    -> family = "one_step" is cheaper
warning unstable_linear: the plant is not stable (radius {value:.4g}) and E[gamma] = {rate:.4g} is
    below 1: a lost signal counts as noise of the size of the state, which grows, and the error of a
    linear filter with it -> family = "imm" or "one_step"
warning compression_loss: the variance of {name} after the first window is {value:.0%} above that of
    dfcf, which loses nothing (all rows at every sample)
    -> {remedy}family = "dfcf", or a shorter window

note not_ergodic: the chain goes round in {value:g} steps: its law has no limit
note not_ergodic.reducible: the chain has several stationary laws: where it starts decides where it
    stays
note impossible_mode.jump: the mode{plural} {names} never come{singular}
    -> another initial, or a transition that leads there, if it can happen
note not_mean_square_stable: not mean-square stable: radius {value:.6g}, the second moments of the
    state grow without bound
warning not_mean_square_stable.noise: not mean-square stable: radius {value:.6g}, the second moments
    of the state grow without bound, and where it is unknown what was lost they act as noise
    -> a detector, or arrival = 'known'
warning nearly_unstable: nearly not mean-square stable: radius {value:.6g}, the second moments of
    the state take {samples:.3g} samples to settle by a factor e -> more damping
note invisible_losses: about {value:.1%} of losses are invisible: the predicted signal is then
    within {visible:g} noise deviations of zero
warning invisible_losses.many: about {value:.1%} of losses are invisible: the predicted signal is
    then within {visible:g} noise deviations of zero
    -> measure from another zero, or filter without a detector
note unused_alpha: nothing uses alpha = {value:g}: it is the false alarm rate of nis
warning energy_rule: the energy rule rejects {value:.1%} of good samples even where nothing was lost
    (Gaussian rows of one size); with what it rejects the prediction drifts, and more is rejected
    -> detector = 'llr', which tests both hypotheses
note one_hypothesis: nis tests one hypothesis: after rejections its gate opens, and a lost sample
    near zero is taken for a good one -> detector = 'llr', which tests both hypotheses

warning unused_parameter: nothing uses the parameter{plural} {names}
    -> take out of [parameters], or use in a matrix
note time_varying: the model changes with its parameters; all figures are for {names}
warning large_code: one step has {value} operations in the text: a large file, slow to compile and
    slow in the instruction cache
    -> zeros in A and C cost nothing: look for a basis with more of them
"""


def _catalogue() -> dict[str, tuple[Severity, str, str]]:
    """Severity, message and remedy by code."""
    found = {}
    for entry in re.split(r"\n+(?=\S)", _TEXTS.strip()):
        head, text = " ".join(entry.split()).split(": ", 1)
        severity, code = head.split()
        message, _, remedy = text.partition(" -> ")
        found[code] = cast("Severity", severity), message, remedy
    return found


FINDINGS = _catalogue()
