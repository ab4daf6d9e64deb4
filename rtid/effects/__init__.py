"""Physical effects that may be missing in the model: the catalogue, and effects of the user's own.

`catalogue()` and `effect(name)` give the pages, `Expression` reads a formula safely, `define` and
`from_expression` make an `Effect` from a function or a formula.
"""

from rtid.effects.expression import Expression
from rtid.effects.page import Effect, EffectError, Parameter, Symbol, catalogue, correcting, effect
from rtid.effects.parsing import ExpressionError
from rtid.effects.user import define, from_expression
from rtid.effects.view import View, names_of, names_of_model

__all__ = [
    "Effect",
    "EffectError",
    "Expression",
    "ExpressionError",
    "Parameter",
    "Symbol",
    "View",
    "catalogue",
    "correcting",
    "define",
    "effect",
    "from_expression",
    "names_of",
    "names_of_model",
]
