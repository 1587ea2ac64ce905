"""Generate scenes such as cities and terrain, with trees and cars."""
