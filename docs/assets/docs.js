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

// On narrow screens the menu opens, changes its level and closes by keyboard too. The theme has Enter, for all labels
// that have the focus, but they cannot get it.
document$.subscribe(() => {
  const [button, toggle] = [document.querySelector("label.md-header__button[for=__drawer]"), document.getElementById("__drawer")];
  const labels = [button, ...document.querySelectorAll(".md-nav--primary :is(.md-nav__title, [for=__toc])")];
  const narrow = matchMedia("(max-width: 76.2344em)");
  const reach = () => labels.forEach((label) => (label.tabIndex = narrow.matches ? 0 : -1));
  const say = () => button.setAttribute("aria-expanded", String(toggle.checked));
  Object.assign(button, { role: "button", ariaLabel: "Menu" });
  narrow.addEventListener("change", reach);
  toggle.addEventListener("change", say);
  reach();
  say();
  button.addEventListener("keydown", (event) => {
    if (event.key !== " ") return;
    event.preventDefault();
    toggle.click();
  });
  document.addEventListener("keydown", ({ key }) => {
    if (key !== "Escape" || !toggle.checked) return;
    toggle.click();
    button.focus();
  });
});
