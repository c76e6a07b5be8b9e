"""Tests of ports, sockets and files."""
