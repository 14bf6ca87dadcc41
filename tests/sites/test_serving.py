"""What the helpers of these tests promise."""

import subprocess
import sys

from tests.sites.serving import Said
from tests.waiting import PATIENCE

TALKATIVE = "import sys\nfor _ in range(20_000): print('x' * 100, file=sys.stderr)"


def test_a_process_that_says_much_is_not_blocked() -> None:
    with subprocess.Popen([sys.executable, "-c", TALKATIVE], stderr=subprocess.PIPE, text=True) as process:
        said = Said(process)
        assert process.wait(PATIENCE) == 0
        assert said.first().startswith("x")
        assert said.all().count("\n") <= 1000
