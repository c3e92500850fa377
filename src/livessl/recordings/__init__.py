"""Recorded sound: files read in blocks like a device, sessions on disk, and the assignment of files to arrays.

This package uses no network and no audio interface.
"""
