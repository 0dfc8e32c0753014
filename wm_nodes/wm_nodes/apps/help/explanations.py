"""What the string under each field of a record says."""

import ast
import inspect
import textwrap


def explanations(record: type) -> dict[str, str]:
    """The string under each field of a class and of those that it is derived from."""
    texts = dict[str, str]()
    for kind in reversed(record.__mro__[:-1]):
        if "__annotations__" not in vars(kind) or kind.__module__ == "typing":
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
        assert isinstance(body, ast.ClassDef)
        for line, below in zip(body.body, body.body[1:]):
            if isinstance(line, ast.AnnAssign) and isinstance(below, ast.Expr):
                texts[ast.unparse(line.target)] = " ".join(str(ast.literal_eval(below.value)).split())
    return texts
