"""numpy_plan"""
