// What the list of jobs and the viewer of the only one have in common: bars, and news of the run.
import { ask } from "./ask.js";
import { element } from "./controls.js";

export const stop = element("button", { type: "button", className: "stop", textContent: "Stop" });
stop.onclick = () => fetch("stop", { method: "POST" });

export const meter = (share) => element("span", { className: "meter" }, element("b", { style: { width: `${100 * share}%` } }));
export const count = ([label, done, whole]) => element(
  "div", { className: "count" }, element("span", { textContent: label }),
  element("span", { textContent: `${done.toLocaleString("en")} / ${whole.toLocaleString("en")}` }), meter(whole ? done / whole : 0),
);

export const slots = ([label, share, whole]) => element(
  "div", { className: "count" }, element("span", { textContent: label }),
  element("span", { textContent: `${Math.round(100 * share)} % of ${whole}`, title: "in the last few seconds" }), meter(share),
);

// Leaves alone what shows this already.
export function replace(box, ...children) {
  const made = element("div", {}, ...children);
  if (made.innerHTML !== box.innerHTML) box.replaceChildren(...made.childNodes);
}

// Asks again and again, until the server has ended or `show` returns true, and returns the last answer.
export async function follow(what, asked, ms, show) {
  stop.hidden = false;
  try {
    for (;;) {
      const told = await ask(what, asked());
      stop.hidden = told.stops === false; // it is no run
      stop.textContent = told.over ? "Close" : told.state === "stopping" ? "Stopping" : "Stop";
      if (await show(told)) return told;
      const pause = told.wait_ms ?? ms;
      await new Promise((done) => setTimeout(done, document.hidden ? 4 * pause : pause));
    }
  } finally {
    stop.hidden = true;
  }
}
