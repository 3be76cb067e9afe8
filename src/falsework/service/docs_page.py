"""OpenAPI description as a self-contained HTML page without external resources."""

from __future__ import annotations

import json
from html import escape
from typing import Any

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #22252a; background: #fff; max-width: 52rem; margin: 2rem auto;
  padding: 0 1rem }
h2 { margin-top: 2.5rem; border-top: 1px solid #ddd; padding-top: 1.2rem; font-family: ui-monospace, monospace }
h2 small { font: 1rem system-ui, sans-serif; color: #56585c; padding-left: .6rem }
table { border-collapse: collapse; width: 100% } td, th { text-align: left; vertical-align: top; padding: .2rem .8rem
  .2rem 0; border-bottom: 1px solid #eee }
code, pre { font: 14px ui-monospace, monospace } pre { background: #f5f3ee; padding: .8rem; overflow: auto }
summary { cursor: pointer; color: #0072b2 }
"""


def page_of(document: dict[str, Any]) -> str:
    """Return HTML for an OpenAPI description, self-contained and without scripts."""
    info = document["info"]
    secured = "components" in document and "securitySchemes" in document["components"]
    sections = [
        _operation(path, method.upper(), operation, document)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    schemas = "\n".join(
        f'<details id="{escape(name)}"><summary><code>{escape(name)}</code></summary>'
        f"<pre>{escape(json.dumps(schema, indent=1, ensure_ascii=False))}</pre></details>"
        for name, schema in document["components"]["schemas"].items()
    )
    token = "<p>Send your token with every request: <code>Authorization: Bearer TOKEN</code>.</p>" if secured else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(info['title'])}</title><style>{_STYLE}</style></head><body>"
        f"<h1>{escape(info['title'])}</h1><p>{escape(info.get('description', ''))}</p>{token}"
        '<p>Machine-readable version: <a href="/openapi.json">/openapi.json</a></p>'
        f"{''.join(sections)}<h2>Schemas</h2>{schemas}</body></html>\n"
    )


def _operation(path: str, method: str, operation: dict[str, Any], document: dict[str, Any]) -> str:
    """Return one operation: its request and its responses."""
    question = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema")
    parts = [f"<h2>{method} {escape(path)}<small>{escape(operation.get('summary', ''))}</small></h2>"]
    command = f"curl http://HOST:PORT{path}"
    if question is not None:
        schema = document["components"]["schemas"][_name(question)]
        parts.append("<table><tr><th>entry</th><th>meaning</th></tr>")
        parts += [_row(name, entry, schema) for name, entry in schema["properties"].items()]
        parts.append("</table>")
        example = {"states": ["complete"]} if "states" in schema["properties"] else {"state": "complete"}
        command += f" -H 'Content-Type: application/json' -d '{json.dumps(example)}'"
    parts.append(f"<pre>{escape(command)}</pre><table>")
    for code, answer in sorted(operation["responses"].items()):
        content = next(iter(answer["content"].values()))
        model = _name(content["schema"])
        link = f' <a href="#{escape(model)}"><code>{escape(model)}</code></a>' if model else ""
        parts.append(f"<tr><td>{code}</td><td>{escape(answer['description'])}{link}</td></tr>")
    return "".join([*parts, "</table>"])


def _row(name: str, entry: dict[str, Any], schema: dict[str, Any]) -> str:
    about = entry.get("description", "")
    if model := _name(entry):
        about += f", see {model}"
    if name in schema.get("required", []):
        about += " (required)"
    elif "default" in entry:
        about += f" (default: {json.dumps(entry['default'])})"
    bounds = [f"{word} {entry[key]}" for key, word in (("minimum", "at least"), ("maximum", "at most")) if key in entry]
    return f"<tr><td><code>{escape(name)}</code></td><td>{escape('; '.join([about.strip(), *bounds]))}</td></tr>"


def _name(schema: dict[str, Any]) -> str:
    return schema.get("$ref", "").rpartition("/")[2]
