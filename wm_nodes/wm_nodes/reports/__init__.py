"""What a run leaves for people: film strips, curves, a table with intervals, report.html and summary.json.

Plain arrays and numbers go in; nothing here knows a model, a policy or a graph.
"""
