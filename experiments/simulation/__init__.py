"""What makes data: shapes, robot cells, sensors, ray casting, builders."""
