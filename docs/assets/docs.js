// What scrolls can be scrolled by keyboard: tables and figures that are wider than the page, and formulas.
document$.subscribe(() => {
  const scrolled = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      if (target.scrollWidth > target.clientWidth) target.tabIndex = 0;
      else target.removeAttribute("tabindex");
    }
  });
  requestAnimationFrame(() => {
    for (const one of document.querySelectorAll(".md-typeset__scrollwrap, .equation, .figure")) scrolled.observe(one);
  });
});

// A moving picture can be stopped, and stands still for readers who prefer reduced motion.
document$.subscribe(() => {
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  for (const picture of document.querySelectorAll(".moving picture")) {
    const [source, image] = [picture.querySelector("source"), picture.querySelector("img")];
    const [moving, still] = [image.src, source.srcset];
    const button = document.createElement("button");
    let playing = !calm.matches;
    const label = () => (button.textContent = playing ? "Pause the picture" : "Play the picture");
    button.type = "button";
    button.addEventListener("click", () => {
      playing = !playing;
      source.remove();
      image.src = playing ? moving : still;
      label();
    });
    label();
    picture.after(button);
  }
});
