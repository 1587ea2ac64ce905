// Shared by the job list and the viewer of a single job: progress bars, and updates from the run.
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

// Changes an element only if its content differs.
export function replace(box, ...children) {
  const made = element("div", {}, ...children);
  if (made.innerHTML !== box.innerHTML) box.replaceChildren(...made.childNodes);
}

// Polls until the server has ended or `show` returns true, and returns the last answer.
export async function follow(what, asked, ms, show) {
  stop.hidden = false;
  try {
    for (;;) {
      const told = await ask(what, asked());
      stop.hidden = told.stops === false; // there is no run to stop
      stop.textContent = told.over ? "Close" : told.state === "stopping" ? "Stopping" : "Stop";
      if (await show(told)) return told;
      const pause = told.wait_ms ?? ms;
      await new Promise((done) => setTimeout(done, document.hidden ? 4 * pause : pause));
    }
  } finally {
    stop.hidden = true;
  }
}
