"""A hierarchy as a whole: its declaration, who learns when, and the policy made of the parts.

Begin with ``roles``, the table of its parts; ``training`` trains them by the stages of
``schedule``.
"""
