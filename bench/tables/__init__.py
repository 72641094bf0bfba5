"""The dissertation's tables, reproduced on the simulated rig beside the published figures: `python -m tables` here.

    page          a table as a page of the documentation
    rig           what is shown to the simulated rig, and what it captures
    strips        2.1-2.3       isolated strips
    interference  gamma (eq. 3.28) and saturation (eq. 3.29-3.36)
    threshold     two-sigma threshold (eq. 5.49-5.51)
    codes         5.1, 5.2      share of right codes after each stage
    depth         5.3-5.7       depth against PMP; first-generation composite pattern
    requirements  what the default decoder must reach
    pictures      of the page on MCP: `python -m tables.pictures`

Nothing here is part of the program. Every figure follows from seeds 0, 1, 2 of the simulated world; nothing else is
random, so that a page changes only when the code or the arithmetic of the machine does.
"""
