"""What the user says: plant, faults, filter and code options, as frozen and checked values."""

from fkgen.problem.code import Code
from fkgen.problem.filter import Filter, Parameter
from fkgen.problem.model import Model
from fkgen.problem.signals import Signal
from fkgen.problem.spec import Spec, load
from fkgen.problem.text.expression import (
    Expression,
    Name,
    Number,
    Operation,
    evaluate,
    names,
    parse,
)
from fkgen.problem.text.matrix import Matrix

__all__ = ["Code", "Expression", "Filter", "Matrix", "Model", "Name", "Number", "Operation"]
__all__ += ["Parameter", "Signal", "Spec", "evaluate", "load", "names", "parse"]
