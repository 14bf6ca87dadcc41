"""Offline: noise levels identified from a healthy record."""
