"""The form of messages to people: every InputError that is raised with a literal, read from the syntax tree."""

import ast
import re

from tests.project.test_style import nodes, place


def messages() -> list[tuple[str, str]]:
    """Return (place, text) of every InputError raised with a literal; parts that are filled in are `{}`."""
    raised = ((path, node.exc) for path, node in nodes() if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call))
    ours = ((path, call) for path, call in raised if isinstance(call.func, ast.Name) and call.func.id == "InputError" and call.args)
    return [(place(path, call, ""), literal(call.args[0])) for path, call in ours]


def literal(node: ast.expr) -> str:
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return str(node.value) if isinstance(node, ast.Constant) else ""


def test_messages_to_people_are_sentences() -> None:
    """One sentence: no full stop at its end, no shouting, no bare refusal, and enough words to say what was expected and what came.

    Messages that are put together of others ({}) are judged where their parts are written.
    """
    texts = [(where, text) for where, text in messages() if text]
    assert len(texts) > 500, "messages are found"
    bare = re.compile(r"\b(invalid|illegal|bad input|failed to)\b", re.IGNORECASE)
    ended = re.compile(r"[^.]\.$|!$")
    assert not [f"{where}{text}" for where, text in texts if ended.search(text) or bare.search(text)]
    assert not [f"{where}{text}" for where, text in texts if len(text.split()) < 5 and "{}" not in text]
