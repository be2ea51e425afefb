// What scrolls can be scrolled by keyboard: tables that are wider than the page, and formulas.
document$.subscribe(() => {
  const scrolled = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      if (target.scrollWidth > target.clientWidth) target.tabIndex = 0;
      else target.removeAttribute("tabindex");
    }
  });
  requestAnimationFrame(() => {
    for (const one of document.querySelectorAll(".md-typeset__scrollwrap, .equation")) scrolled.observe(one);
  });
});
