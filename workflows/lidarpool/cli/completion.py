"""The command `lidarpool completion`: what shells need to complete the others."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from raybeam import available_backends

PROGRAM = "lidarpool"
_VARIABLE = "_LIDARPOOL_COMPLETE"  # in which the script asks; click derives it from the name

SHELLS = ("bash", "zsh", "fish")


@click.command()
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script with which a shell completes commands, options and files.

    To have it in every new shell, once:

    \b
      lidarpool completion bash >> ~/.bashrc
      lidarpool completion zsh >> ~/.zshrc     # below compinit
      lidarpool completion fish > ~/.config/fish/completions/lidarpool.fish

    \b
    Examples:
      lidarpool completion bash >> ~/.bashrc
      source <(lidarpool completion zsh)
    """  # noqa: D301 - click wants the character, not its name
    kind = get_completion_class(shell)
    assert kind is not None, "click has all of SHELLS"
    made = kind(context.find_root().command, {}, PROGRAM, _VARIABLE)
    # `source` of bash's would start bash to ask its version; scripts are made elsewhere, too.
    click.echo(made.source_template % made.source_vars())


def complete_backend(_: click.Context, __: click.Parameter, begun: str) -> list[str]:
    """Backends whose name begins so."""
    return [name for name in ("auto", *available_backends()) if name.startswith(begun)]
