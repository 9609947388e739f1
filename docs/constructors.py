"""Constructors of records: equinox modules and named tuples; griffe knows those of dataclasses."""

import griffe

RECORDS = {"equinox.Module", "eqx.Module", "typing.NamedTuple", "NamedTuple"}


class Constructors(griffe.Extension):
    """Give every record an ``__init__`` of its fields."""

    def on_class(self, *, cls: griffe.Class, **_) -> None:
        bases = {getattr(base, "canonical_path", str(base)) for base in cls.bases}
        if not bases & RECORDS or "__init__" in cls.members:
            return
        parameters = [griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)]
        for field in cls.members.values():
            if not field.is_attribute or field.annotation is None or "property" in field.labels:
                continue
            parameters.append(
                griffe.Parameter(
                    field.name,
                    annotation=field.annotation,
                    kind=griffe.ParameterKind.positional_or_keyword,
                    default=_default(field),
                )
            )
        cls.set_member(
            "__init__", griffe.Function("__init__", parameters=griffe.Parameters(*parameters))
        )


def _default(field: griffe.Attribute) -> object:
    value = field.value
    if not isinstance(value, griffe.ExprCall) or not str(value.function).endswith("field"):
        return value
    for argument in value.arguments:
        if isinstance(argument, griffe.ExprKeyword):
            if argument.name == "default":
                return argument.value
            if argument.name == "default_factory":
                return f"{argument.value}()"
    return None
