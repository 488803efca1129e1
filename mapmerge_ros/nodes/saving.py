# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Services that write the state of the fusion node to a file, and go on from one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mapmerge_msgs.srv import LoadMap, SaveMap

from mapmerge_ros.fusion import FusionEngine
from mapmerge_ros.io import BagError, OutputError, encode_submap
from mapmerge_ros.io.state import load_state, save_state
from mapmerge_ros.nodes.ledger import Ledger


class Saving:
    """One method per service: request and empty response in, filled response out."""

    def __init__(self, engine: FusionEngine, ledger: Ledger, now_ns: Callable[[], int]) -> None:
        self._engine = engine
        self._ledger = ledger
        self._now_ns = now_ns

    def save_map(self, request: Any, response: Any) -> Any:
        """Write all sub-maps, the global frame and what the robots were asked for."""
        codes, state = SaveMap.Response, self._engine.state()
        if not state.submaps:
            response.result = codes.RESULT_NOTHING_TO_SAVE
            response.message = 'no sub-map has arrived yet'
        elif Path(request.path).suffix != '.mcap':
            response.result = codes.RESULT_PATH_NOT_WRITABLE
            response.message = f'{request.path!r}: give a name that ends in .mcap'
        else:
            try:
                save_state(request.path, state, max(self._now_ns(), 0))
            except OutputError as err:
                response.result = codes.RESULT_PATH_NOT_WRITABLE
                response.message = str(err)
        return response

    def load_map(self, request: Any, response: Any) -> Any:
        """Take in what a file holds, beside what is here; the newer of two revisions stays."""
        codes = LoadMap.Response
        if reason := _why_not_found(request.path):
            response.result = codes.RESULT_NOT_FOUND
            response.message = f'{request.path!r}: {reason}'
            return response
        try:
            saved = load_state(request.path)
        except BagError as err:
            response.result, response.message = codes.RESULT_BAD_FORMAT, str(err)
            return response
        receipts = self._engine.restore(saved.state)
        for submap, receipt in zip(saved.state.submaps, receipts, strict=True):
            if receipt.accepted:
                self._ledger.hold(submap, len(encode_submap(submap)), self._now_ns())
        response.sub_maps = sum(receipt.accepted for receipt in receipts)
        reasons = [*(item.refusal for item in saved.refused), *(x.reason for x in receipts)]
        response.message = '; '.join(dict.fromkeys(filter(None, reasons)))
        if not response.sub_maps:
            response.result = codes.RESULT_REFUSED
        return response


def _why_not_found(path: str) -> str:
    """Return why nothing can be read at a path; empty where a file or folder is."""
    if not path:
        return 'no such file'
    try:
        # `exists` has no answer where a folder is closed or a name too long, and raises.
        Path(path).stat()
    except OSError as err:
        return err.strerror or str(err)
    except ValueError as err:  # a name that no file can have
        return str(err)
    return '' if os.access(path, os.R_OK) else 'not readable: permission denied'
