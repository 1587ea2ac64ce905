"""Mesh files for tests."""

from __future__ import annotations

from pathlib import Path

PLY = """ply
format ascii 1.0
element vertex 4
property double x
property double y
property double z
element face 2
property list uchar int vertex_indices
end_header
500000.123456 4000000.5 1
500001.123456 4000000.5 1
500001.123456 4000001.5 1
500000.123456 4000001.5 1
3 0 1 2
3 0 2 3
"""
# Entities of XML, each ten times the one before: &i; is a thousand million of &a;.
NESTED = "".join(
    f'<!ENTITY {name} "{f"&{of};" * 10}">' for of, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def write(path: Path, content: bytes | str) -> Path:
    """Write a file."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path
