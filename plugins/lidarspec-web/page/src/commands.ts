/** The sensor's commands: a form for each, the bytes before they are sent, and what came back. */

import { made } from "./dom";
import type { Argument, Ask, Command, Composed, Hello, Refused, Replied } from "./protocol";

/** Milliseconds from the last key to when the bytes are asked for. */
const SETTLED = 200;
const GROUPS = { ask: "Read", set: "Set", switch: "Start and stop" };
const GROUP_NAMES = Object.keys(GROUPS) as Command["group"][];
const UNCHOSEN = "Choose a command. Its bytes are shown before you send it.";

export class Commands {
  readonly #list = made("div", { className: "list scroll", tabIndex: 0, role: "group", ariaLabel: "Commands" });
  readonly #form = made("form", { className: "form" });
  readonly #bytes = made("div", { className: "bytes" });
  readonly #reply = made("div", { className: "reply" });
  readonly #send = made("button", { textContent: "Send", className: "primary", disabled: true });
  readonly #hindrance = made("p", { className: "hindrance" });
  #command: Command | null = null;
  #control = false;
  #restart: Hello["restart"] = null;
  #streams = false;
  /** the commands that are still to be answered, the one that was sent first */
  #steps: string[] = [];
  /** the arguments of the command that is sent while the sensor is stopped */
  #given: Record<string, string> = {};
  #timer = 0;

  constructor(
    readonly element: HTMLElement,
    readonly ask: (words: Ask) => void,
  ) {
    element.append(made("div", { className: "beside" }, this.#list, made("div", { className: "detail scroll", tabIndex: 0, role: "group", ariaLabel: "Command" }, this.#hindrance, this.#form, this.#bytes, this.#reply)));
    this.#form.onsubmit = (event) => {
      event.preventDefault();
      this.#submit();
    };
    this.#form.oninput = () => {
      this.#send.disabled = true;
      clearTimeout(this.#timer);
      this.#timer = window.setTimeout(() => this.#words("compose"), SETTLED);
    };
  }

  /** The commands of a sensor. */
  show({ commands, control, why_no_control, restart }: Hello): void {
    this.#control = control;
    this.#restart = restart;
    this.#steps = [];
    this.#hindrance.textContent = control || !commands.length ? "" : why_no_control;
    const groups = GROUP_NAMES.flatMap((group) => this.#group(group, commands.filter((command) => command.group === group)));
    this.#list.replaceChildren(...(groups.length ? groups : [made("p", { className: "empty", textContent: "This sensor has no commands." })]));
    const again = commands.find(({ name }) => name === this.#command?.name);
    if (again) return this.#choose(again);
    this.#command = null;
    this.#form.replaceChildren(...(commands.length ? [made("p", { textContent: UNCHOSEN })] : []));
    this.#bytes.replaceChildren();
    this.#reply.replaceChildren();
  }

  /** A heading and the commands under it; nothing if there are none. */
  #group(group: Command["group"], commands: Command[]): HTMLElement[] {
    const buttons = commands.map((command) =>
      made("button", { textContent: command.name, title: command.text, data: { value: command.name }, onclick: () => this.#choose(command) }),
    );
    return buttons.length ? [made("h2", { textContent: GROUPS[group] }), ...buttons] : [];
  }

  /** How the source is doing: a sensor that sends data has to be stopped before some commands. */
  state(state: string): void {
    this.#streams = state === "streaming";
    if (!this.#steps.length) this.#send.textContent = this.#interrupts ? "Stop, send, start again" : "Send";
  }

  /** Whether the sensor is stopped for the chosen command and started again after it. */
  get #interrupts(): boolean {
    return this.#streams && this.#restart !== null && this.#command?.only_stopped === true;
  }

  #submit(): void {
    if (this.#steps.length) return;
    if (!this.#interrupts) {
      this.#say("sent, waiting for the reply");
      return this.#words("send");
    }
    const { stop, start } = this.#restart!;
    this.#given = this.#arguments();
    this.#steps = [stop, this.#command!.name, start];
    this.#say(`sending ${stop} first`);
    this.#step();
  }

  #step(): void {
    const [command] = this.#steps;
    if (command === undefined) return;
    this.ask({ do: "send", command, arguments: this.#steps.length === 2 ? this.#given : {} });
  }

  /** Go on to the next of several commands that are sent after each other. */
  #answered(command: string): void {
    if (this.#steps[0] !== command) return;
    this.#steps.shift();
    this.#step();
  }

  /** The bytes that would be sent. */
  composed({ command, hex, explanation }: Composed): void {
    if (command !== this.#command?.name) return;
    this.#send.disabled = !this.#control;
    const rows = (explanation?.rows ?? []).map((row) =>
      made("tr", {}, ...[row.offset.toString(16).padStart(4, "0"), row.hex, row.path, row.meaning].map((text) => made("td", { textContent: text }))),
    );
    this.#bytes.replaceChildren(made("code", { className: "whole", textContent: hex.match(/../g)?.join(" ") ?? "" }), made("table", {}, made("tbody", {}, ...rows)));
  }

  replied({ command, text, hex }: Replied): void {
    this.#answered(command);
    if (command !== this.#command?.name) return;
    this.#say(text);
    if (hex) this.#reply.append(made("code", { className: "whole", textContent: hex.match(/../g)?.join(" ") ?? "" }));
  }

  refused({ of, command, text, next }: Refused): void {
    if (of === "send" && command !== undefined) {
      if (this.#steps.length === 3) this.#steps = []; // it was not stopped
      else this.#answered(command);
    }
    if (of === "compose") {
      this.#bytes.replaceChildren(made("p", { className: "bad", textContent: text }));
      this.#send.disabled = true;
    } else this.#say([text, next ? `next: ${next}` : ""].filter(Boolean).join("\n"), "bad");
  }

  #say(text: string, verdict = "good"): void {
    this.#reply.replaceChildren(made("pre", { className: verdict, textContent: text }));
  }

  #choose(command: Command): void {
    this.#command = command;
    for (const button of this.#list.querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset.value === command.name));
    this.#form.replaceChildren(made("h2", {}, command.name), made("p", { textContent: command.text }), ...command.arguments.map(field), this.#send);
    this.#bytes.replaceChildren();
    this.#reply.replaceChildren();
    this.#send.disabled = true;
    this.#words("compose");
  }

  /** What the form says, once all that is needed is there. */
  #words(word: "compose" | "send"): void {
    if (!this.#command) return;
    const given = this.#arguments();
    const missing = this.#command.arguments.find(({ name, default: fallback }) => fallback === null && !(name in given));
    if (missing) this.#bytes.replaceChildren(made("p", { className: "faint", textContent: `Enter ${missing.name} to see the bytes.` }));
    else this.ask({ do: word, command: this.#command.name, arguments: given });
  }

  /** The arguments that were given, by name. */
  #arguments(): Record<string, string> {
    const given = [...new FormData(this.#form)].map(([name, text]) => [name, text as string] as const);
    return Object.fromEntries(given.filter(([, text]) => text !== ""));
  }
}

/** A label and what takes an argument: a choice, or text with what may be in it. */
function field({ name, text, unit, low, high, choices, default: fallback }: Argument): HTMLElement {
  const range = low === null || high === null ? "" : `${low} to ${high}`;
  const allowed = [range, unit].filter(Boolean).join(" ");
  const value = fallback === null ? "" : String(fallback);
  const input = choices.length
    ? made("select", { name }, ...choices.map((choice) => made("option", { ...choice, selected: choice.value === value })))
    : made("input", { name, value, placeholder: allowed, autocomplete: "off", spellcheck: false });
  return made("label", {}, made("span", { textContent: name }), input, made("small", { textContent: [allowed, text].filter(Boolean).join(" · ") }));
}
