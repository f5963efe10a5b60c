"""Ctrl-C ends the program with one line and the exit code 130, whatever it does at that moment."""

import subprocess
import sys
import threading

import pytest

from ddrecon.interrupts import defer_interrupt

PRESS = """
import importlib.abc, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
press = lambda: os.kill(os.getpid(), signal.SIGINT)
class PressAt(importlib.abc.MetaPathFinder):
    def __init__(self, module): self.module = module
    def find_spec(self, name, *_):
        if name == self.module: press()
"""
CHECK = "from ddrecon.cli import main; main(['check', 'scene.yaml'])"
MOMENTS = {
    "click is imported": f"sys.meta_path.insert(0, PressAt('click')); {CHECK}",
    "torch is imported": f"sys.meta_path.insert(0, PressAt('torch')); {CHECK}",
    "a command runs": f"""
import ddrecon.scene_file.load as load
load._text = lambda path: press()
{CHECK}""",
    "an interrupt is on its way": f"""
import ddrecon.scene_file.load as load
def read(path):
    try: press()
    finally: press()
load._text = read
{CHECK}""",
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupt_is_one_line(folder: object, moment: str) -> None:
    command = [sys.executable, "-c", PRESS + MOMENTS[moment]]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_other_threads_are_not_interrupted() -> None:
    """As of whoever iterates over `optimize_sequence` in one: there are no signals there."""
    asked = list[list[int]]()

    def work() -> None:
        with defer_interrupt() as numbers:
            asked.append(numbers)

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert asked == [[]]
