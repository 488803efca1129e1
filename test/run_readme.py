# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the blocks of a document, in order: what it shows works. Usage: run_readme.py README.md."""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

BLOCK = re.compile(r'^```(\w+)\n(.*?)^```$', re.MULTILINE | re.DOTALL)
COMMANDS = {'sh': ['bash', '-euo', 'pipefail'], 'python': [sys.executable]}
LIMIT_S = 300


def main(document):
    """Run every `sh` and `python` block in the repository, stop at the first that fails."""
    root = Path(__file__).parents[1]
    path = f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'
    blocks = [
        (kind, text)
        for kind, text in BLOCK.findall(Path(document).read_text())
        if kind in COMMANDS
    ]
    for number, (kind, text) in enumerate(blocks, 1):
        with tempfile.NamedTemporaryFile('w', suffix=f'.{kind}') as script:
            script.write(text)
            script.flush()
            command = [*COMMANDS[kind], script.name]
            done = subprocess.run(
                command,
                cwd=root,
                env={**os.environ, 'PATH': path},
                timeout=LIMIT_S,
                check=False,
                capture_output=True,
                text=True,
                stdin=subprocess.DEVNULL,
            )
        print(f'{document}: block {number} of {len(blocks)} ({kind}): exit {done.returncode}')
        if done.returncode:
            print(text, done.stdout, done.stderr, sep='\n---\n')
            return 1
    return 0 if blocks else 1


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
