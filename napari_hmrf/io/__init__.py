"""Files: studies, fields, images, landmarks, tables and figures."""
