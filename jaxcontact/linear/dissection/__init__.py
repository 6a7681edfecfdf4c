"""Nested dissection with dense fronts: order, plan, factorise, sweep."""
