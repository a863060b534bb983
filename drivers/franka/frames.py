"""A frame in another one, as a rig's file gives it: a pose, or a 4x4 matrix as Franka's interfaces show it."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import model_validator

from hal.config.schema import PoseConfig, is_number
from hal.geometry import Pose, matrix_to_quaternion

__all__ = ["Frame"]


class Frame(PoseConfig):
    """``{position, orientation}``, seven numbers, or four rows of four numbers."""

    @model_validator(mode="before")
    @classmethod
    def _rows(cls, data: Any) -> Any:
        if not isinstance(data, (list, tuple)) or not any(isinstance(row, (list, tuple)) for row in data):
            return data
        if len(data) != 4 or not all(
            isinstance(row, (list, tuple)) and len(row) == 4 and all(map(is_number, row)) for row in data
        ):
            raise ValueError("must be four rows of four numbers, {position, orientation}, or seven numbers")
        matrix = np.array(data, float)
        turn = matrix[:3, :3]
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            raise ValueError("the last row of the matrix must be 0, 0, 0, 1; translations stand in the last column")
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
            raise ValueError("the matrix does not turn a right-handed frame into another one")
        return {"position": matrix[:3, 3].tolist(), "orientation": matrix_to_quaternion(turn).tolist()}

    def matrix(self) -> list[float]:
        """(16,) column by column, as the library takes it."""
        columns: list[float] = Pose(self.position, self.orientation).matrix().T.ravel().tolist()
        return columns
