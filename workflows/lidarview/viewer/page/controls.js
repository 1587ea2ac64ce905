// Controls of the panel: elements that call a function when the user changes them.

export function element(tag, properties = {}, ...children) {
  const { style, dataset, ...rest } = properties;
  const made = Object.assign(document.createElement(tag), rest);
  Object.assign(made.style, style);
  Object.assign(made.dataset, dataset);
  made.append(...children);
  return made;
}

export function saveFile(file, name) {
  const link = element("a", { href: URL.createObjectURL(file), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

const ICONS = {
  play: '<path class="full" d="M4 2.5v11l9-5.5z"/>',
  pause: '<path class="full" d="M4 3h3v10H4zM9 3h3v10H9z"/>',
  back: '<path class="full" d="M12 3v10L5 8z"/><path d="M4 3v10"/>',
  next: '<path class="full" d="M4 3v10l7-5z"/><path d="M12 3v10"/>',
  loop: '<path d="M3 8a5 5 0 0 1 8.5-3.5L13 6M13 3v3h-3M13 8a5 5 0 0 1-8.5 3.5L3 10M3 13v-3h3"/>',
  link: '<path d="M6.5 9.5l3-3M7 5l1.5-1.5a2.8 2.8 0 0 1 4 4L11 9M9 11l-1.5 1.5a2.8 2.8 0 0 1-4-4L5 7"/>',
  picture: '<path d="M2 5h3l1-2h4l1 2h3v8H2z"/><circle cx="8" cy="8.7" r="2.3"/>',
  panel: '<path d="M2.5 4h11M2.5 8h11M2.5 12h11"/>',
  point: '<path d="M3 2l4 11 1.6-4.6L13 7z"/>',
  distance: '<path d="M2 11L11 2l3 3-9 9zM5 8l1.5 1.5M7.5 5.5L9 7"/>',
  angle: '<path d="M13 13H3L10 3M7.5 13a5 5 0 0 0-1.7-4"/>',
  area: '<path d="M3 5l6-2 4 5-3 5H4z"/>',
  clip: '<path d="M2.5 5L8 2.5 13.5 5v6L8 13.5 2.5 11zM2.5 5L8 7.5 13.5 5M8 7.5v6"/>',
  close: '<path d="M4 4l8 8M12 4l-8 8"/>',
  help: '<path d="M5.5 6a2.5 2.5 0 1 1 3.6 2.2C8.3 8.7 8 9.2 8 10M8 12.7v.1"/>',
  theme: '<circle cx="8" cy="8" r="5.5"/><path class="full" d="M8 2.5a5.5 5.5 0 0 1 0 11z"/>',
};

// Labels a control without text, for tooltips and screen readers.
export function explain(control, title) {
  control.title = title;
  control.setAttribute("aria-label", title);
}

export function iconButton(icon, title, act) {
  const made = element("button", { type: "button", className: "icon", onclick: act });
  explain(made, title);
  setIcon(made, icon);
  return made;
}

export function setIcon(button, icon) {
  button.innerHTML = `<svg viewBox="0 0 16 16" aria-hidden="true">${ICONS[icon]}</svg>`;
}

// Switches between light and dark. The default is the user's last choice or the system setting.
export function themeButton(show = () => {}) {
  const systemDark = matchMedia("(prefers-color-scheme: dark)");
  const saved = () => { try { return localStorage.getItem("lidarpool-theme"); } catch { return null; } };
  const set = (theme) => {
    document.documentElement.dataset.theme = theme;
    show(theme);
  };
  const use = () => set(saved() ?? (systemDark.matches ? "dark" : "light"));
  use();
  systemDark.addEventListener("change", use);
  addEventListener("storage", use); // changed by another page, such as the enclosing one
  return iconButton("theme", "Switch between light and dark mode", () => {
    const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    try { localStorage.setItem("lidarpool-theme", theme); } catch { /* a page in a frame may not */ }
    set(theme);
  });
}

export const button = (text, act) =>
  element("button", { type: "button", textContent: text, onclick: act });

export function section(title, open, ...children) {
  return element("details", { open }, element("summary", { textContent: title }), ...children);
}

export const row = (title, ...children) =>
  element("label", { className: "row" }, element("span", { textContent: title }), ...children);

// options: values, or [value, text]
export function menu(title, options, value, act) {
  const made = element("select", { onchange: () => act(made.value) });
  made.setOptions = (entries, chosen) => {
    made.replaceChildren(
      ...entries.map((entry) => {
        const [own, text] = Array.isArray(entry) ? entry : [entry, entry];
        return element("option", { value: own, textContent: text });
      }),
    );
    made.value = chosen;
  };
  made.setOptions(options, value);
  const line = title ? row(title, made) : made;
  if (title) line.menu = made;
  return line;
}

export function slider(title, low, high, step, value, words, act) {
  const shown = element("output", { textContent: words(value) });
  const made = element("input", {
    type: "range", min: low, max: high, step, value,
    oninput: () => { shown.textContent = words(+made.value); act(+made.value); },
  });
  const line = row(title, made, shown);
  line.set = (set) => { made.value = set; made.oninput(); };
  return line;
}

export function tick(title, checked, act) {
  const box = element("input", { type: "checkbox", checked, onchange: () => act(box.checked) });
  const line = element("label", { className: "tick", title }, box, element("span", { textContent: title }));
  line.box = box;
  return line;
}

// The two ends of a range of numbers; null for an end without a limit.
export function dual(title, low, high, step, ends, words, act) {
  const span = high - low || 1;
  const inputs = [0, 1].map((end) =>
    element("input", { type: "range", min: low, max: high, step, value: ends[end] ?? [low, high][end] }));
  const [first, last] = [element("span"), element("span")];
  const fill = element("i");
  const show = () => {
    const [a, b] = inputs.map((input) => +input.value);
    fill.style.left = `${(100 * (a - low)) / span}%`;
    fill.style.right = `${(100 * (high - b)) / span}%`;
    first.textContent = words(a);
    last.textContent = words(b);
    return [a, b];
  };
  inputs.forEach((input, end) => {
    input.setAttribute("aria-label", `${title}, ${end ? "highest" : "lowest"}`);
    input.oninput = () => {
      const [a, b] = inputs.map((other) => +other.value);
      if (a > b) input.value = end ? a : b;
      const [x, y] = show();
      act([x <= low ? null : x, y >= high ? null : y]);
    };
  });
  show();
  const box = element("div", { className: "dual" }, fill, ...inputs);
  const line = element("div", { className: "row" }, element("span", { textContent: title }), box);
  return element("div", {}, line, element("div", { className: "ends" }, first, last));
}

// only: value of the only label that is shown, or null; act(value): called when a label is clicked;
// names: {value: name} for values that the server knows only by number; hidden: values that are off;
// change(value): called when a value is switched on or off.
export function legend(told, only, act, names = {}, hidden = new Set(), change = null) {
  const box = element("div", { className: "legend" });
  if (!told) return box;
  if (!told.labels) {
    const stops = told.colors.map((color) => `rgb(${color})`).join(",");
    box.append(
      element("div", { textContent: told.title }),
      ...(told.colors.length ? [element("div", { className: "bar", style: { background: `linear-gradient(to right,${stops})` } })] : []),
      element("div", { className: "marks" }, ...told.marks.map((text) => element("span", { textContent: text }))),
    );
    return box;
  }
  const list = element("ul");
  for (const [name, color, value] of told.labels) {
    const shown = names[value] ?? (name || `${value}`);
    const press = element(
      "button", { type: "button", title: value === only ? "Show all" : `Show only ${shown}`, onclick: () => act(value) },
      element("i", { style: { background: `rgb(${color})` } }), element("span", { textContent: shown }),
    );
    press.setAttribute("aria-pressed", value === only);
    press.append(element("span", { className: "number", dataset: { value } }));
    const box = element("input", { type: "checkbox", checked: !hidden.has(value), title: hidden.has(value) ? "Show" : "Hide", onchange: () => change(value) });
    box.setAttribute("aria-label", `show ${shown}`);
    list.append(element("li", {}, ...(change ? [box] : []), press));
  }
  if (told.more) list.append(element("li", { textContent: `and ${told.more.toLocaleString("en")} more` }));
  box.append(list);
  return box;
}

// Formats a number with about four significant digits.
export function number(value, step = Number.isInteger(value) ? 1 : Math.abs(value) / 1000) {
  const digits = step > 0 ? Math.min(6, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))) : 0;
  return (+value.toFixed(digits) + 0).toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
}

export function stepFor(span) {
  return 10 ** Math.floor(Math.log10(Math.max(span, 1e-6) / 200));
}
