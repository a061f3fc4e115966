"""The pages that draw a flight: the scene, and three.js, which draws it."""
