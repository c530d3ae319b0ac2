# SPDX-License-Identifier: Apache-2.0
"""The progress bar of a job over many images."""

from __future__ import annotations

from slamdepth.cli.console import error_console, show_log


class JobBar:
    """A progress bar with the time left; where standard error is no terminal, a line now and then.

    A context manager; warnings are printed above the bar.

    Args:
        quiet: show nothing.
    """

    def __init__(self, quiet: bool) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._console = error_console()
        self._bar = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}", markup=False),
            TimeRemainingColumn(compact=True),
            console=self._console,
            disable=quiet or not self._console.is_terminal,
            transient=True,
        )
        self._lines = not quiet and not self._console.is_terminal
        self._task = self._bar.add_task("opening", total=None, state="")
        self._doing = ""
        self._next_line = 0

    def __enter__(self) -> JobBar:
        show_log(target=self._console)
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, doing: str, done: int, total: int, state: str = "") -> None:
        """Show that ``done`` of ``total`` (0: unknown) are done.

        Args:
            doing: the current job; another one restarts the bar.
            done, total: finished and in all.
            state: shown next to the bar.
        """
        is_new = doing != self._doing
        if is_new:
            self._doing, self._next_line = doing, 0
            self._bar.reset(self._task, total=total or None, description=doing, state=state)
        self._bar.update(self._task, completed=done, total=total or None, state=state)
        if self._lines and (is_new or (total and done >= self._next_line)):
            self._next_line = done + max(1, total // 10)
            count = f" {done}/{total}" if total else ""
            self._console.print(f"{doing}{count} {state}".rstrip(), markup=False)
