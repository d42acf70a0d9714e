"""The camera run backwards: shapes, materials, light and a sensor, written as a real capture is."""
